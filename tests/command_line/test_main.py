"""``python -m engine``: what it answers, and with which exit code."""

import argparse
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from unittest import mock

import pytest

from engine.command_line.main import main, make_parser
from engine.job import LiftFolder, LiftRequest, write_atomically, write_manifest
from engine.job.request import add_options
from engine.job.terminal import STOP_SIGNALS
from engine.scene_source import SceneSource, UpAxis
from tests.commands import exit_code, refuse_heavy_help
from tests.job.following import new_lift
from tests.raises_key import worded
from tests.tiny_scene import write_tiny_scene


def code_of(*arguments: str | Path) -> int:
    return exit_code(main, *arguments)


COMMANDS = ("lift", "evaluate", "inspect", "frames", "presets", "warm-up")


@pytest.mark.parametrize("command", [[], *([name] for name in COMMANDS)])
def test_engine_help_imports_no_large_package(root: Path, command: list[str]) -> None:
    refuse_heavy_help(root, "engine.command_line.main", command)


@pytest.mark.parametrize("command", ["lift {}", "export {}-gone --to points -o {}-out"])
def test_missing_input_is_reported_before_torch_loads(root: Path, tmp_path: Path, command: str) -> None:
    folder = LiftFolder.create(tmp_path / "lift", LiftRequest(scene=tmp_path / "gone"))
    code = (
        "import sys\n"
        "from engine.command_line.main import main\n"
        "print(main(sys.argv[1:]), {'torch', 'numba', 'open3d'} & {*sys.modules})"
    )
    arguments = command.replace("{}", str(folder.path)).split()
    call = [sys.executable, "-c", code, *arguments]
    said = subprocess.run(call, cwd=root, capture_output=True, text=True, timeout=60)
    assert "gone" in said.stderr and said.stdout.splitlines()[-1] == "2 set()"


@pytest.mark.skipif(sys.platform == "win32", reason="a broken pipe is another error there")
@pytest.mark.parametrize("arguments", [["presets"], ["presets", "--json"]])
def test_closing_the_pipe_that_reads_the_output_gives_no_traceback(root: Path, arguments: list[str]) -> None:
    reads, writes = os.pipe()
    os.close(reads)
    with os.fdopen(writes, "wb") as nobody:
        said = subprocess.run([sys.executable, "-m", "engine", *arguments], cwd=root, stdout=nobody, stderr=-1)
    assert (said.returncode, said.stderr) == (141, b"")


def test_wrong_command_line_arguments_are_refused(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    for arguments in ([], ["dance"], ["lift"], ["lift", tmp_path, "--size", "big"], ["inspect", tmp_path, "--up", "x"]):
        assert code_of(*arguments) == 2
        told = capsys.readouterr().err
        assert told.startswith("error: ") and told.endswith("--help' lists all options.\n") and told.count("\n") == 1
    assert code_of("lift", tmp_path, "-o", tmp_path / "out", "--prest=draft") == 2
    assert "--prest=draft. Did you mean --preset? 'python -m engine lift --help'" in capsys.readouterr().err
    assert code_of("lift", tmp_path, "--preset", "draft") == 2
    told = capsys.readouterr().err
    assert f"{tmp_path} is not a lift folder" in told and "name a new folder with -o" in told


@pytest.mark.parametrize("text", ["-5", "0", "5-2", "1e3", "many", "9" * 5000])
def test_an_invalid_number_of_frames_is_refused(text: str, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert code_of("lift", tmp_path, "-o", tmp_path / "out", "--frames", text) == 2
    told = capsys.readouterr().err
    assert "argument --frames" in told and "number" in told
    assert code_of("lift", tmp_path, "-o", tmp_path / "out", "--frames", "9999999") == 2
    said = capsys.readouterr().err
    assert said.startswith("error: frames = 9999999 is not a valid value") and said.count("\n") == 1


def test_bad_input_gives_a_one_line_error(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    lift = new_lift(tmp_path)
    for arguments, told in (
        (["inspect", tmp_path / "none"], "none"),
        (["lift", tmp_path / "none"], "there is no such lift folder"),
        (["lift", tmp_path], "request.json"),
        (["lift", lift.path, "--seed", "3"], "--seed"),
        (["lift", lift.path, "--set", "objects=boxes"], "--set"),
        (["lift", tmp_path, "-o", tmp_path / "new", "--set", "objects=boxs"], "Did you mean boxes"),
        (["lift", tmp_path, "-o", tmp_path / "new", "--preset", tmp_path / "no.toml"], "no.toml"),
        (["presets", "preview", "--set", "weights.dept=0"], "Did you mean weights.depth"),
        (["lift", tmp_path, "-o", tmp_path / "new", "--preset", "drft"], "Did you mean draft? '"),
        (["evaluate", tmp_path], "request.json"),
        (["evaluate", lift.path], "not finished"),
    ):
        assert code_of(*arguments) == 2
        said = capsys.readouterr().err
        assert said.startswith("error: ") and said.count("\n") == 1 and told in said
        assert not re.search(r"[.?!]\.(?!\.)", said), "each sentence has one end"


INTERRUPTED = (
    (
        "job.terminal.lift_in_terminal",
        ["lift", "SCENE", "-o", "OUT"],
        "Give the same command with --resume to continue: OUT",
    ),
    ("command_line.inspect_scene.open_asked", ["inspect", "SCENE"], ""),
)


@pytest.fixture(params=STOP_SIGNALS, ids=lambda number: number.name)
def stopping(request: pytest.FixtureRequest) -> Iterator[tuple[Callable[..., None], int]]:
    """Sends this process the signal, and the exit code that follows."""
    number = request.param
    before = signal.signal(number, signal.SIG_DFL)  # ignored where pytest runs in the background
    try:
        yield lambda *_: signal.raise_signal(number), 128 + number
    finally:
        signal.signal(number, before)


@pytest.mark.parametrize(("what", "arguments", "told"), INTERRUPTED)
def test_a_command_stopped_by_a_signal_says_how_to_continue(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, stopping: tuple[Callable[..., None], int],
    what: str, arguments: list[str], told: str,
) -> None:  # fmt: skip
    monkeypatch.setattr(f"engine.{what}", stopping[0])
    assert code_of(*arguments) == stopping[1]
    assert capsys.readouterr().err.splitlines() == [f"Stopped. {told}".strip()]


KNOWN = next(each for each in make_parser()._actions if isinstance(each, argparse._SubParsersAction)).choices


@pytest.mark.parametrize("command", KNOWN)
def test_every_stopped_command_prints_one_line_and_has_the_same_exit_codes(
    capsys: pytest.CaptureFixture[str], stopping: tuple[Callable[..., None], int], command: str
) -> None:
    defaults = {each.dest: each.default for each in KNOWN[command]._actions} | KNOWN[command]._defaults
    options = argparse.Namespace(**defaults | {"command": command, "run": stopping[0]})
    parser = mock.Mock(spec=argparse.ArgumentParser)
    parser.parse_args.return_value = options
    assert main([], lambda: parser) == stopping[1]
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1 and said[0].startswith("Stopped.")


def test_inspect_uses_the_masks_named_in_the_studio_defaults(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    room = write_tiny_scene(tmp_path / "scene", frames=6)
    (tmp_path / "masks" / "scene").mkdir(parents=True)
    for name in ("panoptic", "panoptic.json"):
        (room / name).rename(tmp_path / "masks" / "scene" / name)
    (tmp_path / "plgs.toml").write_text('masks = "masks/{scene}"\n')
    monkeypatch.setenv("PLGS_DEFAULTS", str(tmp_path / "plgs.toml"))
    assert code_of("inspect", room) == 0
    said = capsys.readouterr()
    assert "chair" in said.out and f"masks {tmp_path / 'masks' / 'scene'}" in said.err


@pytest.mark.parametrize("form", [["--up", "-y"], ["--up=-y"]])
def test_the_up_axis_may_be_negative(capsys: pytest.CaptureFixture[str], tmp_path: Path, form: list[str]) -> None:
    assert code_of("inspect", *form, write_tiny_scene(tmp_path / "scene", frames=6)) == 0
    assert "not -y" in capsys.readouterr().out


@pytest.mark.parametrize(("said", "meant"), [("z", "+z"), ("auto", "z"), ("y", "y")])
def test_the_option_up_sets_the_up_axis_of_the_scene(said: str, meant: UpAxis) -> None:
    parser = argparse.ArgumentParser()
    add_options(parser, "up", "scene_format")
    assert parser.parse_args(["--up", said]).up == meant
    assert SceneSource(Path("room"), up=meant).up_option == said


METRICS = """{"format": 1, "test_frames": ["0000"], "tables": [
 {"name": "input masks", "mode": "strict", "miou": 0.5, "pq": 0.25, "sq": 0.75, "rq": 0.3, "psnr": null, "ssim": null,
  "per_class": []},
 {"name": "lifted", "mode": "strict", "miou": 0.625, "miou_true": 0.75, "pq": 0.5, "sq": 0.8, "rq": 0.6, "psnr": 21.5,
  "ssim": 0.75, "pq_frame": 0.7, "id_changes": 0.25,
  "psnr_fitted": 23.25, "depth_error_m": 0.0234,
  "per_class": [{"name": "chair", "iou": 0.5, "pq": 1, "sq": 1, "rq": 1, "tp": 3, "fp": 0, "fn": 1}]}]}"""


def test_evaluate_prints_the_scores(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    lift = new_lift(tmp_path)
    write_atomically(lift.result_path / "metrics.json", METRICS)
    write_manifest(lift.result_path, versions={}, seed=0, settings={}, timings={})
    assert code_of("evaluate", lift.path, "--classes") == 0
    assert capsys.readouterr().out.splitlines() == [
        "             mode    mIoU %  true %  PQ %  SQ %  RQ %  frame PQ %  id changes  PSNR dB  fitted   SSIM"
        "  depth cm",
        "input masks  strict    50.0       -  25.0  75.0  30.0           -           -        -       -      -"
        "         -",
        "lifted       strict    62.5    75.0  50.0  80.0  60.0        70.0        0.25    21.50   23.25  0.750"
        "       2.3",
        "",
        "lifted, strict  IoU %   PQ %   SQ %   RQ %  TP  FP  FN",
        "chair            50.0  100.0  100.0  100.0   3   0   1",
    ]
    assert code_of("evaluate", lift.path, "--json") == 0
    line = capsys.readouterr().out
    assert line.count("\n") == 1 and json.loads(line) == json.loads(METRICS)
    (lift.result_path / "metrics.json").write_text(METRICS.replace("0.625", "0.925"))
    for form in ([], ["--json"]):
        assert code_of("evaluate", lift.path, *form) == 2
        assert worded("file-changed").search(capsys.readouterr().err)


@pytest.mark.parametrize("name", ["model.safetensors", "instances.json"])
@pytest.mark.parametrize("change", [None, b"cut", b"as long, but rotten"])
def test_evaluate_bake_and_export_name_a_damaged_result_file(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, name: str, change: bytes | None
) -> None:
    lift = new_lift(tmp_path)
    for each in ("model.safetensors", "instances.json"):
        write_atomically(lift.result_path / each, b"as long, yet whole.")
    write_manifest(lift.result_path, versions={}, seed=0, settings={}, timings={})
    (lift.result_path / name).unlink()
    if change is not None:
        (lift.result_path / name).write_bytes(change)
    told = set()
    for command in (["evaluate"], ["bake"], ["export", "--to", "boxes", "-o", tmp_path / "out"]):
        assert code_of(command[0], lift.path, *command[1:]) == 2
        told.add(capsys.readouterr().err)
    (line,) = told
    assert line.startswith("error: ") and line.count("\n") == 1
    assert name in line and "python -m engine lift LIFT --resume" in line
    assert not (tmp_path / "out").exists()


def test_bake_with_a_blender_camera_name_points_to_run_plgs(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert code_of("bake", new_lift(tmp_path).path, "--camera", "dolly") == 2
    said = capsys.readouterr().err
    assert (
        worded("no-cameras-file dolly").search(said) and "run_plgs.py --bake camera" in said and said.count("\n") == 1
    )


@pytest.mark.parametrize("command", [["frames"], ["inspect"]])
def test_a_command_ends_when_its_parent_process_ends(root: Path, tmp_path: Path, command: list[str]) -> None:
    room = write_tiny_scene(tmp_path / "room", frames=30)
    asked = [sys.executable, "-m", "engine", *command, room, "-o", tmp_path / "out", "--stay-with-parent"]
    ended = subprocess.run(asked, cwd=root, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=120)
    assert ended.returncode == 3 and not ended.stdout and not (tmp_path / "out").exists()


@pytest.mark.parametrize("command", ["lift", "inspect", "batch"])
def test_a_link_to_itself_is_a_one_line_error(command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    output = [] if command == "inspect" else ["-o", tmp_path / "out"]
    assert code_of(command, tmp_path / "loop", *output) == 2
    said = capsys.readouterr().err
    assert "loop" in said and "Traceback" not in said and len(said.splitlines()) == 1
