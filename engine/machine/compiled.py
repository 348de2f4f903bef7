"""``compiled``, the decorator of every kernel, and where the machine code is kept.

Numba only notices a change in a function's own file, but kernels are compiled into one another across files.
So the cache is a folder named after the text of all packages that have kernels: a new version never runs old code.
``cache_folder`` chooses its place; the package itself may be read-only.
"""

from __future__ import annotations

import hashlib
import logging
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from uuid import uuid4

import numba
from numba.core.registry import cpu_target
from numba.extending import register_jitable
from numpy.typing import NDArray

from .cache_folder import choose_cache_folder

Array = NDArray[Any]
"""An array that a kernel takes. The docstrings state its shape and dtype."""

log = logging.getLogger("plgs.machine")


def _version() -> str:
    """A name for the text of every package of the engine that has kernels, and for the versions of the compilers.

    The whole package is included, as kernels freeze the constants that they use.
    """
    digest = hashlib.sha256(f"{sys.version_info[:2]} {numba.__version__}".encode())
    texts = {source: source.read_bytes() for source in sorted(Path(__file__).parent.parent.rglob("*.py"))}
    packages = {source.parent for source, text in texts.items() if b"compiled import" in text}
    for source, text in texts.items():
        if source.parent in packages:
            digest.update(text)
    return digest.hexdigest()[:16]


CACHE_FOLDER = choose_cache_folder(f"plgs-kernels-{_version()}")


def machine_target() -> tuple[str, str, str]:
    """What Numba compiles for: (triple, processor, features such as "+avx2,-avx512f").

    It depends on this machine and on ``NUMBA_CPU_NAME``, ``NUMBA_CPU_FEATURES`` and ``NUMBA_ENABLE_AVX``. Numba
    separates machine code by the same three values, so code for different targets never mixes.
    """
    target: tuple[str, str, str] = cpu_target.target_context.codegen().magic_tuple()
    return target


_KERNEL: dict[str, Any] = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
_PART: dict[str, Any] = {"error_model": "numpy", "no_cfunc_wrapper": True, "_nrt": False}


def _compiler(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    def decorate(function: Callable[..., Any]) -> Any:
        # read when a function is decorated; other users of Numba in this process keep their own folder
        settings: Any = numba.config
        theirs = settings.CACHE_DIR
        settings.CACHE_DIR = str(CACHE_FOLDER)
        try:
            kernel: Any = numba.njit(cache=True, **_KERNEL, **options)(function)
        finally:
            settings.CACHE_DIR = theirs
        if not settings.DISABLE_JIT:
            # Numba counts the files of a kernel. Two processes that compile it at once, for other types of arguments,
            # may give them one number, and one would then run the other's code.
            files = kernel._cache._cache_file
            usual = files._data_name
            files._data_name = lambda number: f"{usual(number)}.{uuid4().hex[:12]}"
        return kernel

    return decorate


compiled = _compiler()
"""A kernel that Python calls. No multiply-add is fused and no sum is reordered: the two passes must agree on every
weight, bit for bit."""

contracted = _compiler(fastmath={"contract"})
"""A kernel for sums of products that only one pass computes. Multiply-add may be fused."""

parallel_kernel = compiled
"""A kernel for ``threads.parallel_for``, written as ``kernel(worker, workers, *arguments)``: it does this worker's
share of the work. The result does not depend on the number of workers."""

device_function: Callable[[Callable[..., Any]], Any] = register_jitable(**_PART)
"""A function that only kernels call, compiled like ``compiled``. This takes far less time: it has no entry from Python
(where it remains a Python function) and no place in the cache. It does not count references, so it can neither make
arrays nor return them, not even within a tuple."""

inlined = _compiler(inline="always")
"""A piece of one or two kernels. It is compiled only as part of them, never separately, which takes less time."""
