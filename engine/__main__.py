"""``python -m engine``."""

from __future__ import annotations

import os
import sys

if __name__ == "__main__":
    if sys.version_info < (3, 11):  # noqa: UP036 - said here, because the imports that follow say it in riddles
        sys.exit(f"error: the engine needs Python 3.11 or newer, this is {sys.version.split()[0]}")
    from .command_line.main import main

    # OpenMP's threads otherwise spin while they wait. On a machine that does anything else besides, that made a
    # training step several times slower than one thread alone. Read once, when torch is imported: set it before.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    sys.exit(main(sys.argv[1:]))
