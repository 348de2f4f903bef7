"""The decorator of every kernel, ``compiled``, and the cache of machine code. Numba only notices a change in a
function's own file, but kernels are compiled into one another across files. So the cache folder is named after the text
of all packages that have kernels: a new version never runs old code. ``choose_cache_folder`` chooses where it is; the
package itself may be read-only."""

from __future__ import annotations

import atexit
import hashlib
import logging
import os
import shutil
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from stat import S_ISDIR, S_ISVTX, S_IWGRP, S_IWOTH
from typing import Any
from uuid import uuid4

import numba
from numba.core.caching import InTreeCacheLocator
from numba.core.registry import cpu_target
from numba.extending import register_jitable
from numpy.typing import NDArray

from ..user_cache import user_cache_folder

# Only this user can write to the folder of compiled kernels. Numba's index there is a pickle, and reading a pickle can
# run code. Anyone who could write there could run code as this user.


def choose_cache_folder(name: str) -> Path:
    """The folder ``name`` in the first safe place: the user's setting, or else the user's cache folder. If neither is
    safe, it is a temporary folder of this process. Then kernels are compiled at every start, and the log says why."""
    setting = os.environ.get("NUMBA_CACHE_DIR")
    bases = [Path(setting).absolute()] if setting else []
    bases.append(user_cache_folder() / "plgs")
    for base in bases:
        reason = _make(base / name)
        if reason is None:
            return base / name
        log.warning("compiled kernels are not kept in %s: %s", base, reason)
    own = Path(tempfile.mkdtemp(prefix="plgs-kernels-"))  # for this user only, with a name that cannot be guessed
    atexit.register(shutil.rmtree, own, ignore_errors=True)
    return own


def _make(folder: Path) -> str | None:
    """Make the folder. Returns why kernels cannot be kept in it; None if they can."""
    try:
        missing = [each for each in (folder, *folder.parents) if not each.exists()]
        for each in reversed(missing):
            each.mkdir(mode=0o700, exist_ok=True)
        if not os.access(folder, os.W_OK):
            return "it cannot be written"
        return why_unsafe(folder)
    except OSError as error:
        return f"{error.filename} cannot be used ({error.strerror})"


def why_unsafe(folder: Path) -> str | None:
    """Return who else could write to a folder or replace it; None if only this user and root can. Windows manages
    permissions differently, so nothing is checked there."""
    if sys.platform == "win32":
        return None
    for each in (folder, *folder.parents, *folder.resolve().parents):  # of a link, and of what it points to
        found = os.lstat(each)
        is_own = found.st_uid in (0, os.getuid()) if each != folder else found.st_uid == os.getuid()
        if not is_own:
            return f"{each} belongs to another user"
        if each == folder and not S_ISDIR(found.st_mode):
            return f"{each} is not a folder"
        # In a sticky folder, such as /tmp, users cannot replace what belongs to others.
        is_sticky = bool(found.st_mode & S_ISVTX) and each != folder
        if S_ISDIR(found.st_mode) and found.st_mode & (S_IWGRP | S_IWOTH) and not is_sticky:
            return f"others may write to {each} (chmod go-w would mend that)"
    return None


Array = NDArray[Any]
"""An array that a kernel takes. The docstrings state its shape and dtype."""

log = logging.getLogger("plgs.machine")


def _version() -> str:
    """Return a name that changes with the text of every package that has kernels, and with the versions of the
    compilers. Whole packages are included, as kernels freeze the constants that they use."""
    digest = hashlib.sha256(f"{sys.version_info[:2]} {numba.__version__}".encode())
    texts = {source: source.read_bytes() for source in sorted(Path(__file__).parent.parent.rglob("*.py"))}
    packages = {source.parent for source, text in texts.items() if b"compiled import" in text}
    for source, text in texts.items():
        if source.parent in packages:
            digest.update(text)
    return digest.hexdigest()[:16]


CACHE_FOLDER = choose_cache_folder(f"plgs-kernels-{_version()}")


def machine_target() -> tuple[str, str, str]:
    """Return what Numba compiles for: (triple, processor, features such as "+avx2,-avx512f"). It depends on this
    machine and on ``NUMBA_CPU_NAME``, ``NUMBA_CPU_FEATURES`` and ``NUMBA_ENABLE_AVX``. Numba keeps machine code apart
    by the same three values, so code for different targets is never mixed."""
    target: tuple[str, str, str] = cpu_target.target_context.codegen().magic_tuple()
    return target


class KernelFiles(InTreeCacheLocator):
    """Where Numba keeps a kernel's files. Its own rule depends on where the package lies. By this one, a clone and an
    installed extension with the same kernels compile them once."""

    def get_cache_path(self) -> str:
        return str(CACHE_FOLDER / Path(self._py_file).parent.name)


_KERNEL: dict[str, Any] = {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}  # divisions are unchecked
_PART: dict[str, Any] = {"error_model": "numpy", "no_cfunc_wrapper": True, "_nrt": False}


def _compiler(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    def decorate(function: Callable[..., Any]) -> Any:
        # read when a function is decorated; other users of Numba in this process keep their own folders
        settings: Any = numba.config
        theirs = settings.CACHE_LOCATOR_CLASSES
        settings.CACHE_LOCATOR_CLASSES = f"{__name__}.{KernelFiles.__name__}"
        try:
            kernel: Any = numba.njit(cache=True, **_KERNEL, **options)(function)
        finally:
            settings.CACHE_LOCATOR_CLASSES = theirs
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
"""A kernel for sums of products that only one of the two passes computes. Multiply-add may be fused."""

parallel_kernel = compiled
"""A kernel for ``threads.parallel_for``, written as ``kernel(worker, workers, *arguments)``: it does this worker's
share of the work. The result does not depend on the number of workers."""

device_function: Callable[[Callable[..., Any]], Any] = register_jitable(**_PART)
"""A function that only kernels call, compiled like ``compiled``. It compiles far faster, as it has no entry from Python
(where it remains a Python function) and is not cached. It does not count references, so it can neither make arrays nor
return them, not even within a tuple."""

inlined = _compiler(inline="always")
"""Part of one or two kernels. It is compiled only as part of them, never separately, which takes less time."""
