"""Each line of the pages that lets Blender run run_plgs.py fails when the script fails: farms believe the exit code."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from tests.doors.terminal import ROOT

PAGES = (ROOT / "README.md", ROOT / "run_plgs.py", *sorted((ROOT / "docs").glob("*.md")))
LINES = [
    (path.name, match[0].strip("`'\" "))
    for path in PAGES
    for match in re.finditer(
        r"(?:blender |\")-b [^\n]*?--python [^\n`]*run_plgs\.py[^\n`#']*", path.read_text(encoding="utf-8")
    )
]
# As Blender does: it opens the file, runs the script, and goes on after an error unless it has a code for that.
BLENDER = """
import re, runpy, sys, traceback
import bpy
words = sys.argv[1:]
own, script = words[: words.index("--")], words[words.index("--python") + 1]
code = int(own[own.index("--python-exit-code") + 1]) if "--python-exit-code" in own else 0
files = [word for word in own if word.endswith(".blend")]
try:
    if files:
        bpy.ops.wm.open_mainfile(filepath=files[0])
    sys.argv = ["blender", *words]
    runpy.run_path(script, run_name="__main__")
except SystemExit as ended:
    sys.exit(ended.code)
except BaseException:
    traceback.print_exc()
    sys.exit(code)
"""


@pytest.fixture(scope="module")
def blend(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("blends") / "shot.blend"
    make = f"import bpy; bpy.ops.wm.save_as_mainfile(filepath={str(path)!r})"
    subprocess.run([sys.executable, "-c", make], check=True, capture_output=True)
    return path


def test_every_blender_command_line_printed_in_the_docs_is_found() -> None:
    assert {name for name, _ in LINES} >= {"README.md", "run_plgs.py", "passes.md", "command-line.md", "farms.md"}


def run_in_blender(line: str, clone: Path, blend: Path) -> int:
    """The exit code of a line of the pages, in a clone."""
    line = re.sub(r"\$\w+-\$\(\([^)]*\)\)|<STARTFRAME>-<ENDFRAME>", "1-2", line)
    line = re.sub(r"\S*run_plgs\.py", str(clone / "run_plgs.py"), line)
    line = re.sub(r"\b(SHOT|shot|FILE)\.blend\b", str(blend), line).replace("...", "")
    words = [word for word in shlex.split(line.replace("MASKS", "nothing")) if word != "blender"]
    return subprocess.run([sys.executable, "-c", BLENDER, *words], cwd=clone, capture_output=True).returncode


@pytest.mark.parametrize(("page", "line"), LINES)
def test_a_command_that_finds_no_lift_exits_with_error(page: str, line: str, blend: Path, tmp_path: Path) -> None:
    for name in ("engine", "plgs_blender", "operators", "ui", "run_plgs.py", "__init__.py"):
        (tmp_path / name).symlink_to(ROOT / name)
    assert run_in_blender(line, tmp_path, blend) == 2


def test_every_command_exits_with_error_in_a_broken_clone(blend: Path, tmp_path: Path) -> None:
    """As after half an update: the script is not read to its end, and only Blender itself knows."""
    script = (ROOT / "run_plgs.py").read_text(encoding="utf-8")
    (tmp_path / "run_plgs.py").write_text(script.replace("def main(", "raise ImportError('half')\n\ndef main("))
    assert [page for page, line in LINES if "--python-exit-code 1 --python " not in line] == []
    assert run_in_blender(LINES[0][1], tmp_path, blend) == 1
