"""Run the command line: ``python -m research``, or ``python -I research/__main__.py``."""

from __future__ import annotations

import os
import sys

if __name__ == "__main__":
    if not __package__:  # started by its path: with -I Python looks for modules nowhere else
        sys.path.insert(0, os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
        __package__ = "research"
    from .command_line import main

    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as in engine/__main__.py
    sys.exit(main(sys.argv[1:]))
