"""Passes from a script: opening them in the compositor, and what cannot be baked."""

import json
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import bpy
import pytest
from plgs.engine.job import BakeCamera, LiftFolder, read_cameras
from plgs.engine.job.follower import TaskFollower
from plgs.plgs_blender import engine_environment, registry
from plgs.plgs_blender.lift_scene import save_lift
from plgs.plgs_blender.running import lifts

from tests.raises_key import worded

PRETENCE = """
import sys
from pathlib import Path
from engine.job import EventWriter

events = EventWriter(Path(sys.argv[1]) / "events.jsonl")
events.hello(task="bake", threads=1, resumed=False)
events.done("finished")
"""


@dataclass
class Asked:
    """What an engine was asked to bake."""

    frames: list[str] = field(default_factory=list)
    cameras: list[BakeCamera] = field(default_factory=list)
    layers: list[list[str]] = field(default_factory=list)


@pytest.fixture
def baked(monkeypatch: pytest.MonkeyPatch) -> Iterator[Asked]:
    """The engine only pretends."""
    asked = Asked()

    def start_bake(
        lift: LiftFolder, python: Path, frames: list[str], *, cameras: Path | None, layers: list[str],
        stays_with_parent: bool,
    ) -> TaskFollower:  # fmt: skip
        asked.frames.extend(frames)
        asked.layers.append(layers)
        asked.cameras.extend(read_cameras(cameras) if cameras is not None else ())
        return TaskFollower.start([python, "-c", PRETENCE, lift.path], lift.task_files, kind="bake", lift=lift)

    monkeypatch.setattr(engine_environment, "usable_python", lambda: Path(sys.executable))
    monkeypatch.setattr(lifts, "start_bake", start_bake)
    yield asked
    registry.forget_all()


def test_the_compositor_opens_with_passes_of_the_active_camera(lift: Path) -> None:
    bpy.ops.plgs.place_lift(lift_folder=str(lift))
    scene = bpy.context.scene
    passes = next(each for each in bpy.data.scenes if each != scene)
    baked = [marker.name for marker in passes.timeline_markers]
    scene.camera = next(ob for ob in scene.objects if ob.get("frame") == baked[-1])
    assert bpy.ops.plgs.show_passes() == {"FINISHED"}
    assert {marker.name: marker.frame for marker in passes.timeline_markers}[baked[-1]] == passes.frame_current
    assert bpy.context.scene == passes
    assert bpy.ops.plgs.matte_instance(instance=1) == {"FINISHED"}, "from the passes' scene, too"
    assert bpy.ops.plgs.isolate_instance.poll() is False, "what acts on the view needs the room"


def test_the_frame_of_the_active_camera_is_baked(mine: Path, baked: Asked) -> None:
    bpy.ops.plgs.place_lift(lift_folder=str(mine))
    scene = bpy.context.scene
    scene.camera = next(ob for ob in scene.objects if "frame" in ob)
    before = {ob.name: ob.as_pointer() for ob in scene.objects}
    row = next(root for root in bpy.data.collections if root.plgs.instances).plgs.instances[0]
    row.visible = False
    bpy.context.scene.plgs.layers = {"normal"}
    assert bpy.ops.plgs.bake_passes(frames="active") == {"FINISHED"}
    assert baked.frames == [scene.camera["frame"]] and baked.layers == [["normal"]]
    assert {ob.name: ob.as_pointer() for ob in scene.objects} == before, "a bake leaves objects alone"
    assert not row.visible, "and what was hidden"


def test_bake_frame_is_refused_for_a_camera_that_is_not_a_frames(lift: Path, baked: Asked) -> None:
    bpy.ops.plgs.place_lift(lift_folder=str(lift))
    bpy.context.scene.camera = None
    with pytest.raises(RuntimeError, match=worded("other-camera")):
        bpy.ops.plgs.bake_passes(frames="active")
    assert baked.frames == []


def test_only_a_finished_lift_can_be_baked_from_the_panel(lift: Path) -> None:
    settings = bpy.context.scene.plgs
    with bpy.context.temp_override(plgs_panel=settings):
        assert not bpy.ops.plgs.bake_passes.poll()
        settings.lift_folder = str(lift)
        assert bpy.ops.plgs.bake_passes.poll()


def test_the_lift_of_an_opened_file_is_baked_by_default(mine: Path, baked: Asked) -> None:
    save_lift(mine, mine / "lift.blend")
    bpy.ops.wm.open_mainfile(filepath=str(mine / "lift.blend"))
    settings = bpy.context.scene.plgs
    assert not settings.lift_folder
    with bpy.context.temp_override(plgs_panel=settings):
        assert bpy.ops.plgs.bake_passes.poll()
    assert bpy.ops.plgs.bake_passes(frames="all") == {"FINISHED"}
    assert baked.frames == ["all"]


def test_the_active_camera_is_baked_over_the_frame_range(mine: Path, baked: Asked) -> None:
    bpy.ops.plgs.place_lift(lift_folder=str(mine))
    scene = bpy.context.scene
    scene.camera = bpy.data.objects.new("dolly", bpy.data.cameras.new("dolly"))
    scene.collection.objects.link(scene.camera)
    for frame in (1, 20):
        scene.camera.location.x = 0.1 * frame
        scene.camera.keyframe_insert("location", frame=frame)
    scene.frame_start, scene.frame_end = 3, 5
    assert bpy.ops.plgs.bake_camera() == {"FINISHED"}
    assert [each.name for each in baked.cameras] == ["dolly.0003", "dolly.0004", "dolly.0005"]
    assert baked.frames == []
    baked.cameras.clear()
    assert bpy.ops.plgs.bake_camera(camera="dolly", frame_start=8, frame_end=12, frame_step=4) == {"FINISHED"}
    assert [each.name for each in baked.cameras] == ["dolly.0008", "dolly.0012"]
    with pytest.raises(RuntimeError, match="3 to -3 is not a range of frames"):
        bpy.ops.plgs.bake_camera(camera="dolly", frame_start=3, frame_end=-3)


def test_rebaking_a_changed_shot_makes_a_new_version_or_replaces_it(mine: Path, baked: Asked) -> None:
    bpy.ops.plgs.place_lift(lift_folder=str(mine))
    scene = bpy.context.scene
    scene.camera = bpy.data.objects.new("dolly", bpy.data.cameras.new("dolly"))
    scene.collection.objects.link(scene.camera)
    scene.frame_start = scene.frame_end = 3
    assert bpy.ops.plgs.bake_camera(shot="night") == {"FINISHED"}
    scene.camera.location.x += 1.0
    with pytest.raises(RuntimeError, match="camera or its size has changed"):
        bpy.ops.plgs.bake_camera(shot="night")
    baked.cameras.clear()
    assert bpy.ops.plgs.bake_changed_shot(shot="night", how="VERSION") == {"FINISHED"}
    assert bpy.ops.plgs.bake_changed_shot(shot="night", how="REPLACE") == {"FINISHED"}
    assert [each.name for each in baked.cameras] == ["night_v001.0003", "night.0003"]
    assert scene.plgs.shot == "night_v{version:03d}", "and so the next time"


def test_a_render_farm_job_is_written_only_from_a_saved_file(mine: Path, tmp_path: Path) -> None:
    bpy.ops.plgs.place_lift(lift_folder=str(mine))
    scene = bpy.context.scene
    scene.camera = next(ob for ob in scene.objects if "frame" in ob)
    scene.frame_start, scene.frame_end, scene.frame_step = 3, 7, 2
    with pytest.raises(RuntimeError, match="Save it"):
        bpy.ops.plgs.bake_on_farm(lift_folder=str(mine))
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "shot.blend"))
    assert bpy.ops.plgs.bake_on_farm(lift_folder=str(mine)) == {"FINISHED"}
    job = json.loads((mine / "bake" / "farm.json").read_text())
    known = set(re.findall(r'key: "(\w+)"', (Path(__file__).parents[2] / "farm" / "plgs.js").read_text()))
    assert job["type"] == "plgs" and set(job["settings"]) == known
    assert job["settings"]["frames"] == "3,5,7" and job["settings"]["camera"] == scene.camera.name
    assert (job["settings"]["output"], job["settings"]["blend"]) == (str(mine), str(tmp_path / "shot.blend"))
