"""Build and validate the extension's zip and a static repository of it with Blender's own tool. Standard library only.

    python set_up/extension.py FOLDER           # makes FOLDER/plgs-<version>.zip, index.json and index.html

The tool belongs to the `blender` on PATH, if that is new enough to have one, else to the bpy module of the Python that
runs this program."""

from __future__ import annotations

import importlib.util
import re
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
OLDEST = (4, 2)
"""The first Blender with extensions."""


def tool() -> list[str]:
    """Return the command of Blender's extension tool. SystemExit if there is neither a Blender nor its module."""
    blender = shutil.which("blender")
    if blender and (version := version_of(blender)) >= OLDEST:
        return [blender, "--command", "extension"]
    # bpy is located but not imported: importing takes a second, and the tool is a script.
    module = importlib.util.find_spec("bpy")
    if module is None or module.origin is None:
        found = "no blender on PATH" if not blender else f"{blender} is {version[0]}.{version[1]}, older than 4.2"
        raise SystemExit(f"extension: {found}, and this Python has no bpy module: run make set-up")
    scripts = sorted(Path(module.origin).parent.glob("*/scripts/addons_core/bl_pkg/cli/blender_ext.py"))
    return [sys.executable, str(scripts[-1])]


def version_of(blender: str) -> tuple[int, int]:
    """Return the version that the program ``blender`` prints; (0, 0) if it prints none within a minute."""
    try:
        said = subprocess.run([blender, "--version"], capture_output=True, text=True, check=False, timeout=60).stdout
    except (OSError, subprocess.TimeoutExpired):
        return 0, 0
    found = re.search(r"^Blender (\d+)\.(\d+)", said, re.MULTILINE)
    return (int(found[1]), int(found[2])) if found else (0, 0)


def build(folder: Path) -> Path:
    """Build the zip into `folder`, validate it, and return its path. The index that *Get Extensions* reads is written
    beside it. SystemExit if the tool refuses it."""
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob("plgs-*.zip"):
        old.unlink()
    ask([*tool(), "build", "--source-dir", str(ROOT), "--output-dir", str(folder)])
    (path,) = folder.glob("plgs-*.zip")
    ask([*tool(), "validate", str(path)])
    ask([*tool(), "server-generate", "--repo-dir", str(folder), "--html"])
    return path


def ask(command: list[str]) -> None:
    """Run the tool. If it fails, show its output and exit."""
    process = subprocess.run(command, capture_output=True, text=True, check=False)
    if process.returncode != 0:
        raise SystemExit(f"extension: {' '.join(command)}\n{process.stdout}{process.stderr}")


def main(arguments: list[str]) -> int:
    if len(arguments) != 1:
        raise SystemExit("usage: extension.py FOLDER")
    path = build(Path(arguments[0]).resolve())
    print(f"extension: {path.name}, {path.stat().st_size / 1000:.0f} kB, valid")
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
