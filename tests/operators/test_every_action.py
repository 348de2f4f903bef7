"""Everything that the panel offers, with an engine that the panel's own buttons made: nothing is missing in it."""

import importlib.util
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import bpy
import pytest
from plgs.engine.job.handshake import ADDED
from plgs.operators.base import StartsTask
from plgs.plgs_blender import registry
from plgs.plgs_blender.engine_environment import EngineState, choices, status, tasks
from plgs.plgs_blender.owned import lifts_in
from plgs.plgs_blender.running import adding
from plgs.plgs_blender.running.exports import FORMS
from tiny_scene import write_tiny_scene

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux", reason="the cache folder is chosen by XDG_CACHE_HOME"),
    pytest.mark.skipif(importlib.util.find_spec("transformers") is None, reason="writes the network of its masks"),
]
UNTRIED = {
    "plgs.find_scene",
    "plgs.write_classes",
    "plgs.use_this_python",
    "plgs.resume_lift",
    "plgs.refine_lift",
    "plgs.watch_lift",
    "plgs.open_lift",
    "plgs.browse_scene",
    "plgs.make_poses",
    "plgs.import_film",
    "plgs.make_depth",
    "plgs.set_scale",
    "plgs.answer_proposal",
    "plgs.try_sample",
}
"""They start what others of these start; poses are made in tests/poses, depth and scales in test_masks.py."""


@pytest.fixture
def online(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Nothing was set up, and the user lets Blender download."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("PLGS_ENGINE_PYTHON", raising=False)
    bpy.context.preferences.system.use_online_access = True
    yield
    registry.forget_all()
    choices.choose(None)
    bpy.context.preferences.system.use_online_access = False


def do(name: str, **given: object) -> str:
    """Call an operator as a script does; it waits for the engine. Its name."""
    assert getattr(bpy.ops.plgs, name)(**given) == {"FINISHED"}, name
    return f"plgs.{name}"


def asked() -> None:
    """Wait until the engine has answered what it is."""
    for check in registry.running(tasks.EngineCheck):
        registry.wait_for(check, bpy.context.scene)
    assert status().state is EngineState.READY, status()


def test_every_action_works_with_the_engine_that_the_buttons_made(online: None, tmp_path: Path) -> None:
    """It downloads more than a gigabyte and takes some minutes."""
    from tests.segment.tiny_mask2former import save_tiny_mask2former

    called = {do("set_up_engine"), do("check_engine")}
    assert tmp_path in (status().python or Path()).parents and adding.lacking("lift") == ()
    assert all(adding.lacking(name) for name in ADDED), "the set-up alone downloads what everybody needs"
    for name in ADDED:
        called.add(do("add_to_engine", capability=name))
        asked()
        assert adding.lacking(name) == ()

    folder = write_tiny_scene(tmp_path / "room", frames=14, size=(96, 72))
    settings = bpy.context.scene.plgs
    bare = shutil.copytree(folder, tmp_path / "bare", ignore=shutil.ignore_patterns("panoptic*", "gt"))
    settings.scene_folder = str(bare)
    called.add(do("make_masks", model=str(save_tiny_mask2former(tmp_path / "model"))))
    settings.scene_folder = str(folder)
    called |= {do("look_at_scene"), do("read_classes"), do("import_scene"), do("diagnose")}
    called.add(do("show_picture", what="DEPTH"))
    lift = tmp_path / "lift"
    called.add(do("lift_scene", scene_folder=str(folder), lift_folder=str(lift), steps=20, bake="none"))
    called |= {do("bake_passes", frames="test"), do("bake_camera", frame_start=1, frame_end=1)}
    one, other = [row.instance_id for row in lifts_in(bpy.context.scene)[0].plgs.instances][:2]
    do("merge_instances", instances=f"{one} {other}")
    called |= {do("split_by_views", instance=one), do("remove_instances", instances=str(one)), do("make_meshes")}
    called.add(do("make_depth_cloud", frame="0000"))
    for form in FORMS:
        called.add(do("export_lift", form=form, directory=str(tmp_path / form), frames="test"))
        assert any((tmp_path / form).iterdir()), form
    called.add(do("remove_engine"))

    starting, kinds = list[type](), [StartsTask]
    while kinds:
        kinds = [each for kind in kinds for each in kind.__subclasses__()]
        starting += [each for each in kinds if issubclass(each, bpy.types.Operator)]
    names = {each.bl_idname.replace("PLGS_OT_", "plgs.") for each in starting}
    assert names - called - UNTRIED == {"plgs.fix_scene"} & names, "nothing is wrong here that Fix could mend"
