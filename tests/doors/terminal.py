"""A terminal in a folder that looks like the clone: the commands that the pages print run there as they stand."""

import os
import re
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGES = ("captures", "clean-plates", "command-line", "corrections", "farms", "masks", "passes", "scripting")
"""Pages whose commands the tests in this folder run, a file a page."""
# Programs run in forks of a process that has imported the engine; what needs bpy has a process of its own.
_PYTHON = """#!/bin/sh
case "$1" in
    -m) part=$2; shift 2; exec "{quick}" "{root}/$part/__main__.py" "$@" ;;
    -c | *run_plgs.py) exec "{own}" "$@" ;;
    *) exec "{quick}" "$@" ;;
esac
"""


@dataclass(frozen=True)
class Terminal:
    """A terminal whose current folder is ``folder``, with what a clone has for commands and a ready `.venv`."""

    folder: Path

    @classmethod
    def like_a_clone(cls, folder: Path, quick_python: Path) -> "Terminal":
        python = folder / ".venv" / "bin" / "python"
        python.parent.mkdir(parents=True)
        python.write_text(_PYTHON.format(quick=quick_python, root=ROOT, own=sys.executable))
        python.chmod(0o755)
        for name in ("engine", "plgs_blender", "operators", "ui", "research", "sample", "run_plgs.py", "__init__.py"):
            (folder / name).symlink_to(ROOT / name)
        return cls(folder)

    def run(self, printed: str, code: int = 0, more: Sequence[str] = (), **names: object) -> str:
        """What a command says on both streams, after it ended with ``code``. The values of ``names`` stand in for these
        words of the page, ``id6=2`` for a 6; ``more`` are further options."""
        command = printed
        for name, value in names.items():
            command = re.sub(rf"(?<![\w.]){re.escape(name.removeprefix('id'))}(?![\w.])", str(value), command)
        command = " ".join([command, *more])
        environment = {**os.environ, "PLGS_ENGINE_PYTHON": str(self.folder / ".venv/bin/python")}
        ran = subprocess.run(
            ["/bin/bash", "-c", command], cwd=self.folder, env=environment, capture_output=True, text=True
        )
        assert ran.returncode == code, f"{command}\n{ran.returncode}: {ran.stdout}{ran.stderr}"
        return ran.stdout + ran.stderr


def commands_of(page: str) -> list[str]:
    """The commands in the blocks of a page, without comments."""
    text = (ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```(\w*)\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    lines = [line for kind, block in blocks if kind in ("", "sh") for line in block.splitlines()]
    commands = [line.split("  #")[0].removeprefix("$ ").strip() for line in lines]
    return [line for line in commands if re.match(r"\S*python3? |PYTHON |blender |sbatch |curl |make ", line)]
