"""Make a Debian tree with a real Blender and a virtual screen, for the tests in a window. Standard library only.

    python set_up/blender_window.py trixie      # Blender 4.3, in build/blender-trixie
    python set_up/blender_window.py sid         # Blender 5.2, in build/blender-sid

Run it as root on a Debian. Packages come from the machine's own sources. A tree is complete when its stamp, which is
written last, names the present packages. Any other tree is made again."""

from __future__ import annotations

import os
import shutil
import subprocess
import time
from pathlib import Path

from environment import LIBRARIES, ROOT, STAMP, alone, exit_with, install_packages, run, say, stop, write_stamp

SUITES = ("trixie", "sid")
PACKAGES = (
    "blender",
    "python3-numpy",
    "python3-cattr",  # Blender 5.2 needs it for extensions, though Debian's package does not say so
    "xvfb",
    "xdotool",
    "python3-xlib",  # to drop files on the window
    "libgl1-mesa-dri",
    *LIBRARIES.values(),  # the engine runs in the tree too, with this machine's environment
)
TOOLS = {"debootstrap": "debootstrap", "unshare": "util-linux", "nsenter": "util-linux", "mount": "mount"}
# Flushing files to the disk, manuals and translations would take half of the time.
DPKG_OPTIONS = """force-unsafe-io
path-exclude=/usr/share/doc/*
path-exclude=/usr/share/man/*
path-exclude=/usr/share/locale/*
"""


def tree_of(suite: str) -> Path:
    return ROOT / "build" / f"blender-{suite}"


def stamp_text(suite: str) -> str:
    return "\n".join([suite, *PACKAGES, ""])


def is_complete(suite: str) -> bool:
    """Whether the tree was completed with the packages that the list has now."""
    stamp = tree_of(suite) / STAMP
    return stamp.is_file() and stamp.read_text() == stamp_text(suite)


def mirror() -> str:
    """Return the address from which this machine's own Debian packages come."""
    wanted = ["--format", "$(REPO_URI)", "Created-By: Packages", "Origin: Debian", "Label: Debian", "Component: main"]
    command = ["apt-get", "indextargets", *wanted]
    addresses = subprocess.run(command, capture_output=True, text=True, check=False).stdout.split()
    if not addresses:
        stop("apt knows of no Debian mirror here; the window tests need a Debian with its usual apt sources")
    return addresses[0]


def make(suite: str) -> None:
    """Make the tree of a Debian ``suite`` from scratch."""
    started = time.monotonic()
    tree = tree_of(suite)
    if os.geteuid() != 0 or shutil.which("apt-get") is None:
        stop("the window tests need root on a Debian, to make a tree with Debian's Blender and a virtual screen in it")
    if tree.exists():
        say(f"{tree.name} is incomplete or has other packages: making it again")
        shutil.rmtree(tree)
    missing = sorted({package for tool, package in TOOLS.items() if shutil.which(tool) is None})
    # This also refreshes the lists that name the mirror, so it runs even if nothing is missing.
    install_packages(missing or ["debootstrap"])
    say(f"making {tree.name}, a Debian with Blender and a virtual screen (2 minutes, 1 GB)")
    run(["debootstrap", "--variant=minbase", suite, str(tree), mirror()], f"{tree.name} could not be made", cwd=ROOT)
    (tree / "etc/dpkg/dpkg.cfg.d/plgs").write_text(DPKG_OPTIONS)
    install = ["apt-get", "install", "-y", "--no-install-recommends", *PACKAGES]
    in_tree(tree, install, "Blender could not be installed", strict=suite != "sid")
    if suite == "sid":
        # Packages of one day may not fit together yet. A second attempt often completes the first.
        in_tree(tree, ["dpkg", "--configure", "-a"], "Blender could not be configured")
        in_tree(tree, install, "Blender could not be installed")
    in_tree(tree, ["apt-get", "clean"], "the downloaded packages could not be removed")
    in_tree(tree, ["blender", "--version"], "Blender does not start")
    write_stamp(tree, stamp_text(suite))
    say(f"{tree.name} is ready after {time.monotonic() - started:.0f} s")


def in_tree(tree: Path, command: list[str], failure: str, *, strict: bool = True) -> None:
    script = str(ROOT / "set_up" / "in_tree.sh")
    quiet = ["env", "DEBIAN_FRONTEND=noninteractive", "LC_ALL=C.UTF-8"]
    run(["sh", script, str(tree), "--", *quiet, *command], failure, cwd=ROOT, strict=strict)


def main(arguments: list[str]) -> int:
    if len(arguments) != 1 or arguments[0] not in SUITES:
        stop(f"usage: blender_window.py {'|'.join(SUITES)}")
    suite = arguments[0]
    with alone():
        if not is_complete(suite):
            make(suite)
    return 0


if __name__ == "__main__":
    exit_with(main)
