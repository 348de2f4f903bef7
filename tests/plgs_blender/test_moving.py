"""A project that was moved is whole, and a lift that was moved alone is found again. Done with real files."""

import os
import shutil
from pathlib import Path

import bpy
import pytest
import tiny_lift
from plgs.engine.corrections.edits import read_edits
from plgs.plgs_blender import corrections
from plgs.plgs_blender.chosen_scene import absolute
from plgs.plgs_blender.inspecting.selection import find_lift
from plgs.plgs_blender.lift_scene import place_lift
from plgs.plgs_blender.owned import FOLDER, LIFT, PLACE, SCENE, folder_of, gone, lifts_in
from plgs.plgs_blender.running import lifting
from plgs.plgs_blender.settings import PATHS

from tests.tiny_scene import write_tiny_scene
from tests.ui.drawn_panels import drawn

pytestmark = pytest.mark.usefixtures("extension")


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A folder with a capture, its lift and, saved beside them from the startup file, a .blend of both."""
    bpy.ops.wm.read_homefile(use_empty=False, use_factory_startup=True)
    folder = tmp_path / "project"
    capture = write_tiny_scene(folder / "room", frames=8, size=(64, 48))
    shutil.copytree(capture / "panoptic", folder / "masks")
    assert bpy.ops.plgs.import_scene(scene_folder=str(capture), masks=str(folder / "masks")) == {"FINISHED"}
    lift = tiny_lift.write_tiny_lift(folder / "room_lift", capture)
    assert bpy.ops.plgs.place_lift(lift_folder=str(lift.path)) == {"FINISHED"}
    bpy.context.scene.plgs.masks = str(folder / "masks")
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "film.blend"))
    return folder


def stored() -> list[str]:
    """Every path that the open file stores."""
    scenes = bpy.data.scenes
    kept = [root[name] for scene in scenes for root in lifts_in(scene) for name in (FOLDER, SCENE)]
    kept += [text for scene in scenes for root in lifts_in(scene) for text in root.get(PLACE, {}).values()]
    kept += [getattr(scene.plgs, name) for scene in scenes for name in PATHS]
    kept += [image.filepath for image in bpy.data.images]
    return [path for path in kept if "/" in path]


def moved(project: Path, to: Path) -> bpy.types.Collection:
    """The lift in the opened file of the project, all of which was moved."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    shutil.move(project, to)
    return opened((to / "film.blend").rename(to / "cut 2.blend"))


def opened(blend: Path) -> bpy.types.Collection:
    bpy.ops.wm.open_mainfile(filepath=str(blend))
    return find_lift(bpy.context.scene)


@pytest.fixture
def other_disk() -> Path:
    folder = Path("/dev/shm") / f"plgs-moved-{os.getpid()}"
    if not os.access("/dev/shm", os.W_OK):
        pytest.skip("there is no other disk")
    yield folder
    shutil.rmtree(folder, ignore_errors=True)


def check_whole(root: bpy.types.Collection, home: Path) -> None:
    assert stored() and all(path.startswith("//") for path in stored()), stored()
    assert all(absolute(path).exists() and absolute(path).is_relative_to(home) for path in stored()), stored()
    assert folder_of(root) == home / "room_lift" and root[LIFT] not in gone | corrections.outdated
    followed = lifting.followed_lift(bpy.context.scene.plgs)
    assert followed is not None and followed.has_result, "it can be baked and exported"
    assert bpy.ops.plgs.rename_instance(instance=1, name="throne") == {"FINISHED"}
    assert [each.name for each in read_edits(home / "room_lift")] == ["throne"]
    assert "Show It Anew" not in drawn() and "Find Lift" not in drawn()
    assert bpy.ops.plgs.place_lift(lift_folder=str(folder_of(root))) == {"FINISHED"}
    assert lifts_in(bpy.context.scene) == [root]


@pytest.mark.parametrize("name", ["elsewhere", "Zürich 2/the film"])
def test_a_moved_project_folder_still_finds_all_its_files(project: Path, tmp_path: Path, name: str) -> None:
    (tmp_path / name).parent.mkdir(exist_ok=True)
    check_whole(moved(project, tmp_path / name), tmp_path / name)


def test_paths_on_another_disk_stay_absolute(project: Path, other_disk: Path) -> None:
    check_whole(moved(project, other_disk), other_disk)


def test_paths_stay_right_when_the_file_is_saved_elsewhere(project: Path, tmp_path: Path) -> None:
    """Save As takes the paths along; a copy leaves the open file's alone, and so does a failure."""
    open_ones = stored()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "copy.blend"), copy=True)
    assert stored() == open_ones
    with pytest.raises(RuntimeError):
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "missing" / "film.blend"))
    assert stored() == open_ones
    (project / "cuts").mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(project / "cuts" / "one.blend"))
    assert all(path.startswith("//../") for path in stored())
    assert opened(tmp_path / "copy.blend") and {path.split("/")[2] for path in stored()} == {"project"}
    check_whole(opened(project / "cuts" / "one.blend"), project)


def test_paths_stay_absolute_if_blenders_preference_says_so(project: Path, tmp_path: Path) -> None:
    filepaths = bpy.context.preferences.filepaths
    filepaths.use_relative_paths = False
    try:
        root = find_lift(bpy.context.scene)
        root[SCENE] = str(project / "room")
        bpy.ops.wm.save_mainfile()
        assert root[SCENE] == str(project / "room") and root[FOLDER] == "//room_lift"
    finally:
        filepaths.use_relative_paths = True
    bpy.ops.wm.save_mainfile()
    assert root[SCENE] == "//room"


def test_saving_a_file_reads_no_scene_or_lift(project: Path) -> None:
    from plgs.plgs_blender import settings

    heard = []
    for listeners in (settings.on_scene_chosen, settings.on_lift_chosen):
        listeners.append(heard.append)
    try:
        bpy.ops.wm.save_as_mainfile(filepath=str(project / "room" / "inside.blend"))
    finally:
        settings.on_scene_chosen.remove(heard.append)
        settings.on_lift_chosen.remove(heard.append)
    assert not heard


def test_a_lift_on_a_read_only_share_is_shown(project: Path, tmp_path: Path) -> None:
    """It opens and looks whole; what a rename cannot do is said."""
    root = moved(project, tmp_path / "share")
    lift = tmp_path / "share" / "room_lift"
    lift.chmod(0o500)
    try:
        if os.access(lift, os.W_OK):  # root may write anywhere: what stands in the file's way does the same
            (lift / "corrections.json").mkdir()
        root.plgs.instances[0].name = "throne"
    finally:
        lift.chmod(0o700)
    assert root.plgs.instances[0].name == "chair 1"
    assert corrections.failed and corrections.failed[0] in drawn()


def test_the_user_is_asked_once_for_a_lift_that_moved(project: Path, tmp_path: Path) -> None:
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    shutil.move(project / "room_lift", tmp_path / "lifts of may")
    root = opened(project / "film.blend")
    assert "Find Lift…" in drawn() and "Show It Anew" not in drawn()
    root.plgs.instances[0].name = "throne"
    assert root.plgs.instances[0].name == "chair 1" and "room_lift" in corrections.failed[0]
    box = bpy.data.objects["chair 1 box"]
    box.location.x += 1.0
    at = box.location.x
    assert bpy.ops.plgs.find_lift(directory=str(tmp_path / "lifts of may")) == {"FINISHED"}
    assert "Find Lift…" not in drawn() and box.location.x == at, "the user's changes stay"
    assert lifts_in(bpy.context.scene) == [root] and folder_of(root) == tmp_path / "lifts of may"
    bpy.ops.wm.save_mainfile()
    root = opened(project / "film.blend")
    assert "Find Lift…" not in drawn()
    assert all(absolute(path).exists() and path.startswith("//") for path in stored()), stored()
    root.plgs.instances[0].name = "throne"
    assert root.plgs.instances[0].name == "throne"


def test_find_lift_refuses_another_lift(project: Path, tmp_path: Path) -> None:
    shutil.move(project / "room_lift", tmp_path / "gone")
    other = tiny_lift.write_tiny_lift(tmp_path / "other", instances=1)
    root = find_lift(bpy.context.scene)
    with pytest.raises(RuntimeError, match="another lift"):
        bpy.ops.plgs.find_lift(directory=str(other.path))
    assert root[FOLDER] == "//room_lift"


def test_opening_a_moved_lift_makes_no_second_copy(project: Path, tmp_path: Path) -> None:
    """As a file saved by an earlier version has it: with absolute paths to where everything was."""
    root = find_lift(bpy.context.scene)
    root[FOLDER], root[SCENE] = str(project / "room_lift"), str(project / "room")
    shutil.move(project, tmp_path / "new")
    assert bpy.ops.plgs.open_lift(directory=str(tmp_path / "new" / "room_lift")) == {"FINISHED"}
    assert lifts_in(bpy.context.scene) == [root]
    assert folder_of(root) == tmp_path / "new" / "room_lift" and absolute(root[SCENE]) == tmp_path / "new" / "room"
    assert not [image for image in bpy.data.images if image.filepath and not absolute(image.filepath).is_file()]


def test_two_lifts_in_one_file_are_kept_apart(project: Path, tmp_path: Path) -> None:
    other = tiny_lift.write_tiny_lift(tmp_path / "other", instances=1)
    second = place_lift(other.path, bpy.context.scene)
    first = next(root for root in lifts_in(bpy.context.scene) if root != second)
    bpy.context.view_layer.objects.active = None
    for chosen in (second, first):
        assert bpy.ops.plgs.choose_lift(lift=chosen.name) == {"FINISHED"}
        assert find_lift(bpy.context.scene) == chosen
        assert first.name in drawn() and second.name in drawn()
    bpy.context.view_layer.objects.active = next(ob for ob in second.all_objects if ob.type == "MESH")
    assert find_lift(bpy.context.scene, active=bpy.context.active_object) == second
    assert bpy.ops.plgs.choose_lift(lift=first.name) == {"FINISHED"}
    assert find_lift(bpy.context.scene, active=bpy.context.active_object) == first
