"""``python -m research``, or ``python -I research/__main__.py``."""

from __future__ import annotations

import os
import sys

if __name__ == "__main__":
    if not __package__:  # started by its path: with -I nothing else is where Python looks for modules
        sys.path.insert(0, os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
        __package__ = "research"
    from .command_line import main

    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as engine/__main__.py has it
    sys.exit(main(sys.argv[1:]))
