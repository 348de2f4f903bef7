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


@pytest.mark.parametrize(("page", "line"), LINES)
@pytest.mark.parametrize("is_broken", [True, False], ids=["broken clone", "no lift"])
def test_a_failed_command_exits_with_error(page: str, line: str, is_broken: bool, blend: Path, tmp_path: Path) -> None:
    for name in ("engine", "plgs_blender", "operators", "ui", "run_plgs.py", "__init__.py"):
        if not (is_broken and name == "plgs_blender"):
            (tmp_path / name).symlink_to(ROOT / name)
    script = tmp_path / "run_plgs.py"
    if is_broken:  # as after half an update
        script.unlink()
        script.write_text(
            (ROOT / "run_plgs.py").read_text().replace("def main(", "raise ImportError('half')\n\ndef main(")
        )
    line = re.sub(r"\$\w+-\$\(\([^)]*\)\)|<STARTFRAME>-<ENDFRAME>", "1-2", line)
    line = re.sub(r"\S*run_plgs\.py", str(script), line)
    line = re.sub(r"\b(SHOT|shot|FILE)\.blend\b", str(blend), line).replace("...", "")
    words = [word for word in shlex.split(line.replace("MASKS", "nothing")) if word != "blender"]
    ran = subprocess.run([sys.executable, "-c", BLENDER, *words], cwd=tmp_path, capture_output=True, text=True)
    assert ran.returncode == (1 if is_broken else 2), f"{line}\n{ran.stdout}{ran.stderr}"
