"""Make one of the project's Python environments, or check that it already exists. Standard library only.

    python set_up/environment.py check .venv       # exit code 0: complete and up to date
    python set_up/environment.py make .venv        # with any Python from 3.8 on

`.venv` runs everything. `.venv-next` is for tests of the Blender side on the next Blender; it has no torch, because the
engine runs in an environment of its own. An environment is complete when its stamp, which is written last, names the
present requirements. Any other environment is made again."""

from __future__ import annotations

import ctypes
import fcntl
import hashlib
import importlib
import os
import platform
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple, NoReturn

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "engine" / "set_up"))
uv_program = importlib.import_module("uv_program")  # with which Blender sets an engine up, too

STAMP = "complete"

# What bpy, open3d and opencv load from the system: the library's file name and the Debian package that has it. RPM's
# programs install a library by its file name.
LIBRARIES = {
    "libX11.so.6": "libx11-6",
    "libXext.so.6": "libxext6",
    "libXrender.so.1": "libxrender1",
    "libXi.so.6": "libxi6",
    "libXfixes.so.3": "libxfixes3",
    "libxkbcommon.so.0": "libxkbcommon0",
    "libSM.so.6": "libsm6",
    "libICE.so.6": "libice6",
    "libGL.so.1": "libgl1",
    "libEGL.so.1": "libegl1",
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libidn2.so.0": "libidn2-0",
}
_USER = re.compile(r"(?<=://)[^/@\s]+@")
"""A name and password in the address of an index. They do not belong in a log."""


class Recipe(NamedTuple):
    """What an environment holds: requirement files for each call of uv, and modules that must import at the end."""

    calls: tuple[tuple[str, ...], ...]
    modules: tuple[str, ...]


BLENDER = {(3, 11): "blender-4.5.txt", (3, 13): "blender-5.3.txt"}
ENGINE_MODULES = ("torch", "open3d", "cv2", "OpenEXR", "numba", "scipy", "safetensors", "lz4", "pycocotools")


def recipe(environment: str, version: tuple[int, int]) -> Recipe:
    """Return the recipe of `.venv` or `.venv-next` for a Python `version`; ValueError if Blender has no such Python."""
    if version not in BLENDER:
        raise ValueError(f"no Blender runs on Python {version[0]}.{version[1]}")
    blender = BLENDER[version]
    if environment == ".venv-next":
        return Recipe(((blender, "next.txt"),), ("bpy", "numpy", "cv2", "OpenEXR", "pytest"))
    files = (("torch.txt",), (blender, "engine.txt", "test.txt", "segment.txt", "farm.txt", "report.txt"))
    # bpy comes first: it crashes when it is imported after open3d.
    return Recipe(files, ("bpy", "numpy", *ENGINE_MODULES, "pytest", "transformers"))


def constraints(version: tuple[int, int]) -> str:
    """Return the file that pins the requirements' own dependencies."""
    return f"constraints-{version[0]}.{version[1]}.txt"


def stamp_text(environment: str, version: tuple[int, int], requirements: Path) -> str:
    """Return the text of the stamp: the Python version and the SHA-256 of each requirement file."""
    names = [name for call in recipe(environment, version).calls for name in call] + [constraints(version)]
    lines = [f"{hashlib.sha256((requirements / name).read_bytes()).hexdigest()}  {name}" for name in names]
    return "\n".join([f"Python {version[0]}.{version[1]}", *lines, ""])


def is_complete(folder: Path, version: tuple[int, int], requirements: Path) -> bool:
    """Whether the environment in `folder` was completed from these requirements."""
    stamp = folder / STAMP
    return stamp.is_file() and stamp.read_text() == stamp_text(folder.name, version, requirements)


def missing_packages() -> list[str]:
    """Return the Debian packages of needed system libraries that this machine lacks."""
    missing = []
    for library, package in LIBRARIES.items() if sys.platform.startswith("linux") else ():
        try:
            ctypes.CDLL(library)
        except OSError:
            missing.append(package)
    return missing


def refuse_old_system() -> None:
    """Exit if the system's C library is too old for the wheels of Open3D."""
    name, release = platform.libc_ver()
    if name == "glibc" and tuple(int(part) for part in release.split(".")) < (2, 35):
        stop(f"Open3D needs glibc 2.35 (Ubuntu 22.04, Debian 12, Fedora 36, RHEL 10), but this system has {release}")


def install_packages(packages: list[str]) -> None:
    """Install Debian packages if we are root; else say in one line how to, and exit."""
    apt = shutil.which("apt-get")
    line = f"apt-get install --no-install-recommends {' '.join(packages)}"
    if apt is None:
        rpm = next((name for name in ("dnf", "zypper", "yum") if shutil.which(name)), None)
        if rpm is None:
            stop(f"this machine lacks system libraries. With Debian's names: {' '.join(packages)}")
        files = [f"'{library}()(64bit)'" for library, package in LIBRARIES.items() if package in packages]
        line = f"{rpm} install {' '.join(files)}"
        stop(f"this machine lacks system libraries. Install them, then run make again:\n\n    sudo {line}\n")
    if os.geteuid() != 0:
        stop(f"this machine lacks system packages. Install them, then run make again:\n\n    sudo {line}\n")
    say(f"installing system packages: {' '.join(packages)}")
    quiet = ["-qq", "-o", "DPkg::Lock::Timeout=300", "-o", "Dpkg::Use-Pty=0"]
    run([apt, *quiet, "update"], "apt-get update failed", strict=False)
    run([apt, *quiet, "-y", "--no-install-recommends", "install", *packages], f"{line} failed")


def find_python(uv: Path, environment: str) -> tuple[str, tuple[int, int]]:
    """Return the Python for an environment, as `uv venv` takes it, and its version. For `.venv` it is the first of
    BLENDER's versions that is on this computer, else one that uv downloads; for `.venv-next` "" if it is missing."""
    versions = list(BLENDER)
    if environment == ".venv-next":
        versions = [(3, 13)] if (ROOT / ".venv/bin/python3.11").exists() else []
    pyenv = Path(os.environ.get("PYENV_ROOT", str(Path.home() / ".pyenv"))) / "versions"
    for version in versions:
        name = "{}.{}".format(*version)
        # pyenv shows only those that are enabled.
        for python in (name, *map(str, sorted(pyenv.glob(f"{name}.*/bin/python{name}")))):
            command = [str(uv), "python", "find", "--no-project", "--no-python-downloads", python]
            variables = uv_program.variables(os.environ)
            if subprocess.run(command, capture_output=True, env=variables, check=False).returncode == 0:
                return python, version
    return ("3.11", (3, 11)) if environment == ".venv" else ("", (3, 13))


def install_options(files: tuple[str, ...], version: tuple[int, int]) -> list[str]:
    """Return the options of one `uv pip install` call. The index of CPU builds that the user named is for torch alone,
    which is installed without its dependencies: the next call adds those."""
    options = ["--constraint", constraints(version)]
    for name in files:
        options += ["--requirement", name]
    if files != ("torch.txt",):
        return [*options, "--requirement", "torch.txt", "pip"] if "engine.txt" in files else options
    index = os.environ.get("TORCH_INDEX", "")
    return [*options, "--no-deps", *(["--index", index] if index else [])]


def make(folder: Path) -> None:
    """Make the environment in `folder`, unless it is complete, or it is `.venv-next` and there is no Python for it."""
    started = time.monotonic()
    refuse_old_system()
    if setting := uv_program.diverted(os.environ, ROOT / "requirements"):
        stop(f"{setting} keeps packages out of {folder.name}. Remove it from uv's settings, then run make again.")
    try:
        uv = uv_program.fetch(ROOT / "build", uv_program.variables(os.environ))
    except OSError as error:
        stop(f"{error}. Check the connection and the package index, then run make again.")
    request, version = find_python(uv, folder.name)
    if not request or is_complete(folder, version, ROOT / "requirements"):
        return
    wanted = recipe(folder.name, version)
    packages = missing_packages()
    if packages:
        install_packages(packages)
    if folder.exists():
        say(f"{folder.name} is incomplete or has older requirements: making it again")
        shutil.rmtree(folder)
    say(f"making {folder.name} for Python {version[0]}.{version[1]}")
    run([str(uv), "venv", "--no-project", "--python", request, str(folder)], f"{folder.name} could not be made")
    python = str(folder / "bin" / "python")
    for files in wanted.calls:
        say(f"installing {', '.join(file[:-4] for file in files)} (this takes half a minute or more)")
        options = install_options(files, version)
        run([str(uv), "pip", "install", "--python", python, *options], "uv could not install the requirements")
    # This finds a missing system library now, and not in the middle of a lift.
    run([python, "-c", f"import {', '.join(wanted.modules)}"], "an installed module cannot be imported")
    if folder.name == ".venv":
        say("compiling the engine's kernels for this machine (half a minute; otherwise a lift would do it)")
        run([python, "-m", "engine", "warm-up"], "the kernels could not be compiled", cwd=ROOT, strict=False)
    write_stamp(folder, stamp_text(folder.name, version, ROOT / "requirements"))
    say(f"{folder.name} is ready after {time.monotonic() - started:.0f} s")


def write_stamp(folder: Path, text: str) -> None:
    """Mark the environment as complete. The stamp is renamed into place, so it is whole or absent."""
    temporary = folder / f"{STAMP}.tmp"
    temporary.write_text(text)
    os.sync()  # after a power cut, the stamp must not outlive the files that uv wrote
    temporary.replace(folder / STAMP)


def run(command: list[str], failure: str, *, cwd: Path = ROOT / "requirements", strict: bool = True) -> None:
    """Run a command, logged in build/set-up.log. If it fails, show the log's end and ``failure``; exit if `strict`."""
    log_path = ROOT / "build" / "set-up.log"
    with log_path.open("ab") as log:
        log.write(_USER.sub("****@", f"\n$ {' '.join(command)}\n").encode())
        log.flush()
        begin = log.tell()
        # The lock is passed on (close_fds=False). If this process is killed, it stays held until uv has ended too.
        code = subprocess.run(
            command, cwd=cwd, env=uv_program.variables(os.environ), stdin=subprocess.DEVNULL,
            stdout=log, stderr=subprocess.STDOUT, close_fds=False, check=False,
        ).returncode  # fmt: skip
    if code == 0:
        return
    with log_path.open("rb") as log:
        log.seek(begin)
        tail = log.read().decode(errors="replace").splitlines()[-20:]
    print("\n".join(tail), file=sys.stderr)
    if strict:
        stop(f"{failure} (exit code {code}). The whole output: build/set-up.log. Run make again to retry.")
    say(f"{failure} (exit code {code}); continuing without it")


@contextmanager
def alone() -> Iterator[None]:
    """Hold the lock on this folder's set-up in a ``with`` block, after waiting for another set-up that holds it."""
    (ROOT / "build").mkdir(exist_ok=True)
    with (ROOT / "build" / "set-up.lock").open("w") as lock:
        os.set_inheritable(lock.fileno(), True)  # to uv, see `run`
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            say("another set-up of this folder is running: waiting for it")
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def say(message: str) -> None:
    print(f"set-up: {message}", flush=True)


def stop(message: str) -> NoReturn:
    print(f"set-up: {message}", file=sys.stderr)
    raise SystemExit(1)


def main(arguments: list[str]) -> int:
    if len(arguments) != 2 or arguments[0] not in ("check", "make") or arguments[1] not in (".venv", ".venv-next"):
        stop("usage: environment.py check|make .venv|.venv-next")
    verb, folder = arguments[0], ROOT / arguments[1]
    if verb == "check":
        return 0 if is_complete(folder, sys.version_info[:2], ROOT / "requirements") else 1
    with alone():
        make(folder)
    return 0


def exit_with(main: Callable[[list[str]], int]) -> NoReturn:
    """Run ``main`` with the command's arguments, and end with its exit code."""
    try:
        raise SystemExit(main(sys.argv[1:]))
    except KeyboardInterrupt:
        print("\nset-up: interrupted; the next make starts it again", file=sys.stderr)
        raise SystemExit(130) from None


if __name__ == "__main__":
    exit_with(main)
