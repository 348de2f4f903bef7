"""farm/plgs.js: compiled as Flamenco 3's manager does it, by its documented API, and run as its workers would."""

import json
import subprocess
import sys
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from engine.command_line.main import make_parser
from engine.job import LiftFolder, LiftRequest, verify
from engine.job.terminal import resumable
from tests.tiny_scene import write_tiny_scene

py_mini_racer = pytest.importorskip("py_mini_racer", reason="mini-racer is not installed: requirements/test.txt")

MANAGER = """
const tasks = [];
const author = {
    Task: (name, type) => ({
        name, type, commands: [], dependencies: [],
        addCommand(command) { this.commands.push(command); },
        addDependency(task) { this.dependencies.push(task.name); },
    }),
    Command: (name, parameters) => ({ name, parameters }),
};
function frameChunker(frames, size) {
    const numbers = [];
    for (const part of frames.split(",")) {
        const [first, last] = part.split("-").map(Number);
        for (let frame = first; frame <= (last === undefined ? first : last); frame++) numbers.push(frame);
    }
    const chunks = [];
    for (let start = 0; start < numbers.length; start += size) {
        const parts = [];
        for (const frame of numbers.slice(start, start + size)) {
            const open = parts[parts.length - 1];
            if (open && open[1] === frame - 1) open[1] = frame; else parts.push([frame, frame]);
        }
        chunks.push(parts.map(([a, b]) => a === b ? `${a}` : `${a}-${b}`).join(","));
    }
    return chunks;
}
"""
"""What the manager gives a script. Its frameChunker joins frames that follow one another, and lists the others."""


def compiled(root: Path, settings: Mapping[str, object]) -> list[dict[str, Any]]:
    """The tasks of a job, in the order in which they were added."""
    with py_mini_racer.MiniRacer() as javascript:
        javascript.eval(MANAGER + (root / "farm" / "plgs.js").read_text())
        known = json.loads(javascript.eval("JSON.stringify(JOB_TYPE.settings)"))
        given = {each["key"]: settings.get(each["key"], each.get("default")) for each in known}
        assert set(settings) <= set(given) and all(given[each["key"]] for each in known if each.get("required"))
        job = f"{{settings: {json.dumps(given)}, addTask(task) {{ tasks.push(task); }}}}"
        return json.loads(javascript.eval(f"compileJob({job}); JSON.stringify(tasks)"))


def lines_of(task: dict[str, Any]) -> list[list[str]]:
    assert all(each["name"] == "exec" for each in task["commands"])
    return [[each["parameters"]["exe"], *each["parameters"]["args"]] for each in task["commands"]]


def test_a_flamenco_job_bakes_a_camera_in_parallel_tasks(root: Path) -> None:
    tasks = compiled(root, {"scene": "{shared}/a room", "output": "{shared}/lift", "blend": "{shared}/shot.blend",
                            "camera": "dolly", "shot": "s",
                            "frames": "1-4,9", "chunk_size": 2, "layers": "normal"})  # fmt: skip
    assert [task["name"] for task in tasks] == ["lift", "bake-1-2", "bake-3-4", "bake-9", "collect"]
    assert [task["dependencies"] for task in tasks] == [
        [],
        ["lift"],
        ["lift"],
        ["lift"],
        [t["name"] for t in tasks[1:4]],
    ]
    lift, *_, last, collect = (lines_of(task)[0] for task in tasks)
    engine = ["{plgsPython}", "{plgs}/engine/__main__.py"]
    assert lift == [*engine, "lift", "{shared}/a room", "-o", "{shared}/lift", "--resume", "--preset", "standard"]
    assert last == [
        "{plgsPython}", "{plgs}/run_plgs.py", "-o", "{shared}/lift", "--bake", "camera", "--blend",
        "{shared}/shot.blend", "--camera=dolly", "--shot=s", "--range", "9-9", "--layers", "normal",
    ]  # fmt: skip
    assert collect[1:] == ["{plgs}/run_plgs.py", *lift[3:]]


@pytest.mark.parametrize("name", ["a b", "it's", 'say "x"', "$(touch x)", "`touch x`", "a\nb", "--force", "; rm -r ."])
def test_flamenco_passes_odd_names_as_one_argument(name: str, root: Path) -> None:
    """exec runs no shell. A camera is the only name that may begin with a dash: the others are paths."""
    folder = f"/shared/{name}"
    given = {"scene": folder, "output": folder, "blend": f"{folder}.blend", "camera": name, "frames": "1"}
    lift, bake, collect = (lines_of(task)[0] for task in compiled(root, given))
    assert lift[2:6] == ["lift", folder, "-o", folder] and collect[2:5] == [folder, "-o", folder]
    assert bake[2:] == ["-o", folder, "--bake", "camera", "--blend", f"{folder}.blend", f"--camera={name}",
                        "--range", "1-1"]  # fmt: skip


def test_flamenco_bakes_scattered_frames_in_one_task(root: Path) -> None:
    settings = {"scene": "/room", "output": "/lift", "bake": "frames", "frames": "1-3,7,9", "chunk_size": 9}
    (bake,) = compiled(root, settings)[1:-1]
    assert [line[-1] for line in lines_of(bake)] == ["1-3", "7-7", "9-9"]


def test_a_flamenco_job_keeps_an_old_lifts_options(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The job that the button writes, for a lift with changed options: its commands go on with that lift."""
    pytest.importorskip("bpy")
    from plgs.plgs_blender.shot_bakes import write_farm_job

    write_tiny_scene(tmp_path / "room", frames=2)
    lift = LiftFolder.create(
        tmp_path / "lift", LiftRequest(scene=tmp_path / "room", preset="preview", options={"steps": 10})
    )
    saved = SimpleNamespace(data=SimpleNamespace(filepath=str(tmp_path / "shot.blend")))
    monkeypatch.setattr("plgs.plgs_blender.shot_bakes.bpy", saved)
    blender_scene = SimpleNamespace(name="Scene", plgs=SimpleNamespace(layers={"normal"}))
    shot = SimpleNamespace(frames=range(1, 4), step=1, only=(), given="", cuts=(), camera=SimpleNamespace(name="dolly"))
    job = json.loads(write_farm_job(blender_scene, lift, shot).read_text())
    some = SimpleNamespace(**{**vars(shot), "frames": (1.0, 3.5), "only": (1.0, 3.5)})
    chosen = json.loads(write_farm_job(blender_scene, lift, some).read_text())
    assert (job["settings"]["frames"], chosen["settings"]["frames"]) == ("1-3", "1,3.5")
    lifting, _, collect = compiled(root, job["settings"])
    for line in (lines_of(lifting)[0][2:], ["lift", *lines_of(collect)[0][2:]]):
        options = make_parser().parse_args(line)
        found = resumable(options)
        assert found is not None and found.request == lift.request


@pytest.mark.slow
@pytest.mark.parametrize("bake", ["camera", "frames"])
def test_the_commands_of_a_flamenco_job_run(bake: str, root: Path, tmp_path: Path) -> None:
    """In order, two at a time; paths come by a variable, as on a worker of another system."""
    pytest.importorskip("bpy")
    write_tiny_scene(tmp_path / "room", frames=8, noise=0.1)
    options = {"lift_options": "--steps 10", "preset": "preview", "chunk_size": 2, "bake": bake, "frames": "0-3"}
    tasks = compiled(root, {"scene": "{shared}/room", "output": "{shared}/lift", **options})
    values = {"{plgsPython}": sys.executable, "{plgs}": str(root), "{shared}": str(tmp_path)}

    def run(task: dict[str, Any]) -> None:
        for line in lines_of(task):
            for name, value in values.items():
                line = [part.replace(name, value) for part in line]
            said = subprocess.run(line, cwd=tmp_path, capture_output=True, text=True, timeout=200)
            assert said.returncode == 0, (line, said.stderr)

    lift, *bakes, collect = tasks
    run(lift)
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(run, bakes))
    run(collect)
    passes = {file.path.stem for file in verify(tmp_path / "lift" / "result").files if file.path.suffix == ".exr"}
    wanted = {f"{frame:04d}" for frame in range(4)}
    assert (wanted if bake == "frames" else {"lift_Overview.0000"}) <= passes
    assert (tmp_path / "lift" / "lift.blend").stat().st_size > 0
