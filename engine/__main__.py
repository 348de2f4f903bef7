"""``python -m engine``."""

from __future__ import annotations

import os
import sys

from .command_line.main import main

if __name__ == "__main__":
    # OpenMP's threads otherwise spin while they wait. On a machine that does anything else besides, that made a
    # training step several times slower than one thread alone. Read once, when torch is imported: set it before.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    sys.exit(main(sys.argv[1:]))
