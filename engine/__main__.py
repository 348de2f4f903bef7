"""Run the command line: ``python -m engine``, or ``python -I engine/__main__.py`` (see `job.process.engine_call`)."""

from __future__ import annotations

import atexit
import os
import sys

if __name__ == "__main__":
    if sys.version_info < (3, 11):  # noqa: UP036 - said here, because the imports that follow fail without a reason
        sys.exit(f"error: the engine needs Python 3.11 or newer, this is {sys.version.split()[0]}")
    if not __package__:  # started by its path: with -I nothing else is where Python looks for modules
        sys.path.insert(0, os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
        __package__ = "engine"
    from .command_line.main import main

    # OpenMP's threads otherwise spin while they wait. On a machine that does anything else besides, that made a
    # training step several times slower than one thread alone. Read once, when torch is imported: set it before.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    code = main(sys.argv[1:])
    if "torch" in sys.modules:  # Python takes a second to take torch apart. Nothing that must be done waits for that.
        atexit._run_exitfuncs()
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)
