"""In odd surroundings that few users have, each command works or ends with one line, never with a traceback."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.tiny_scene import write_tiny_scene

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="a shell sets these limits; names may be any bytes")

FILES = dict.fromkeys(("HOME", "XDG_CACHE_HOME", "PLGS_CACHE_DIR", "TMPDIR"), "FILE")
VARIABLES = {
    "no such folders": {**dict.fromkeys(FILES, "/proc/nowhere"), "LC_ALL": "xx_YY.UTF-99"},
    "files for folders": {**FILES, "LC_ALL": "C"},
}
SHELLS = {
    "private and few files": "umask 077; ulimit -n 64",
    "no current folder": "mkdir gone; cd gone; rmdir ../gone",
    "a current folder with broken characters": r"mkdir $'\xff'; cd $'\xff'",
    "no streams": "exec <&- >&- 2>&-",
    "no room on standard error": "exec 2>/dev/full",
}
NAMES = {"odd characters": "\u00e4\u90e8 '\" $x %20 #\t\n ".encode(), "a long path": b"/".join([b"d" * 199] * 18)}


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny_scene(tmp_path_factory.mktemp("odd") / "scene", frames=2)


def said_by(
    root: Path, tmp_path: Path, *arguments: str | bytes | Path, shell: str = "", **variables: str
) -> tuple[int, bytes, bytes]:
    """The exit code of an engine's command, and what it wrote."""
    (tmp_path / "file").touch()
    own = {name: value.replace("FILE", str(tmp_path / "file")) for name, value in variables.items()}
    command = ["bash", "-c", f'{shell}\nexec "$@"', "bash", sys.executable, root / "engine/__main__.py", *arguments]
    said = subprocess.run(command, cwd=tmp_path, env={**os.environ, **own}, capture_output=True, timeout=300)
    return said.returncode, said.stdout, said.stderr


@pytest.mark.parametrize("unbuffered", ["", "1"])
@pytest.mark.parametrize("call", ["presets", "presets --json", "handshake", "lift --help"])
def test_writing_standard_output_to_a_full_disk_gives_a_one_line_error(
    call: str, unbuffered: str, root: Path, tmp_path: Path
) -> None:
    if unbuffered and "--help" in call:
        pytest.skip("argparse says nothing then")
    code, _, told = said_by(root, tmp_path, *call.split(), shell="exec >/dev/full", PYTHONUNBUFFERED=unbuffered)
    assert code == 1 and told.startswith(b"error: the disk is full. Make room there, ") and told.count(b"\n") == 1


@pytest.mark.parametrize("odd", [*VARIABLES, *SHELLS])
def test_inspect_works_in_unusual_shell_environments(odd: str, root: Path, tmp_path: Path, scene: Path) -> None:
    code, out, told = said_by(root, tmp_path, "inspect", scene, shell=SHELLS.get(odd, ""), **VARIABLES.get(odd, {}))
    assert code == 0 and b"Traceback" not in told
    assert b"frames    2 for training" in out or odd == "no streams"


def test_a_memory_limit_that_is_too_small_is_refused_before_a_lift_starts(root: Path, tmp_path: Path) -> None:
    code, _, told = said_by(root, tmp_path, "lift", "nowhere", shell="ulimit -v 1000000")
    assert code == 2 and told.startswith(b"error: the memory limit (ulimit -v) is 1.0 GB") and told.count(b"\n") == 1


@pytest.mark.parametrize("odd", NAMES)
def test_scenes_with_unusual_folder_names_are_read(odd: str, root: Path, tmp_path: Path) -> None:
    place = Path(os.fsdecode(os.fsencode(tmp_path) + b"/" + NAMES[odd]))
    write_tiny_scene(tmp_path / "scene", frames=2)
    place.parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / "scene").rename(place)
    code, out, told = said_by(root, tmp_path, "inspect", place)
    assert code == 0 and b"frames    2 for training" in out and b"Traceback" not in told


@pytest.mark.parametrize("command", ["inspect", "frames"])
def test_inspect_and_frames_refuse_paths_not_in_utf8(command: str, root: Path, tmp_path: Path, scene: Path) -> None:
    place = os.fsencode(tmp_path) + b"/b\xff"
    shutil.copytree(os.fsencode(scene), place)
    code, _, told = said_by(root, tmp_path, command, place, *(("-o", "made") if command == "frames" else ()))
    assert code == 2 and b"is not UTF-8" in told and told.count(b"\n") == 1


@pytest.mark.parametrize(
    ("scene_name", "lift_name", "why"),
    [
        (b"b\xff", b"lift", b"is not UTF-8"),
        (b"room", b"b\xff", b"is not UTF-8"),
        (b"room", b"d" * 300, b"File name too long"),
        (b"room", b"file/lift", b"Not a directory"),
    ],
)
def test_unusable_paths_give_a_one_line_error(
    scene_name: bytes, lift_name: bytes, why: bytes, root: Path, tmp_path: Path, scene: Path
) -> None:
    names = [os.fsencode(tmp_path) + b"/" + name for name in (scene_name, lift_name)]
    if len(scene_name) < 256:
        shutil.copytree(os.fsencode(scene), names[0])
    code, _, told = said_by(root, tmp_path, "lift", names[0], "-o", names[1])
    assert code == 2 and why in told and told.count(b"\n") == 1 and told.startswith(b"error: ")


@pytest.mark.slow  # the kernels are compiled again, as there is no place to keep them
def test_a_lift_works_in_an_unusual_environment(root: Path, tmp_path: Path, scene: Path) -> None:
    shell, lift = "umask 077; ulimit -n 64; mkdir gone; cd gone; rmdir ../gone; exec <&-", tmp_path / "l\u00eft \u90e8"
    tiny = ("--steps", "2", "--set", "warm_start=false", "--bake", "all")
    odd = {**FILES, "NUMBA_CACHE_DIR": "FILE", "LC_ALL": "C"}
    code, _, told = said_by(root, tmp_path, "lift", scene, "-o", lift, *tiny, shell=shell, **odd)
    assert code == 0, told
    assert len([*(lift / "result" / "passes").iterdir()]) == 2
