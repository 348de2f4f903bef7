"""``python -m engine``, or ``python -I engine/__main__.py`` (see `job.process.engine_call`)."""

from __future__ import annotations

import atexit
import os
import sys

_LEAST_MEMORY = 2_000_000_000
"""Bytes of address space below which OpenBLAS and torch can fail to start, or start and never end."""


def _memory_limit() -> int:
    """The limit of this process's address space (ulimit -v) in bytes; -1 where there is none."""
    try:
        import resource
    except ImportError:  # Windows
        return -1
    return resource.getrlimit(resource.RLIMIT_AS)[0]


if __name__ == "__main__":
    if sys.version_info < (3, 11):  # noqa: UP036 - said here, because the imports that follow fail without a reason
        sys.exit(f"error: the engine needs Python 3.11 or newer, this is {sys.version.split()[0]}")
    if 0 <= (limit := _memory_limit()) < _LEAST_MEMORY:
        print(f"error: the memory limit (ulimit -v) is {limit / 1e9:.1f} GB, too small for the engine. "
              f"Raise it to at least {_LEAST_MEMORY / 1e9:.0f} GB.", file=sys.stderr)  # fmt: skip
        sys.exit(2)
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
