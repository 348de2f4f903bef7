"""A batch writes nowhere but into its own folders, and what an earlier one did counts only while all of it is there."""

import argparse
import shutil
from pathlib import Path

import pytest

from engine.batch.plan import (
    BatchPlan,
    Row,
    SceneJob,
    done_before,
    lifting_code,
    names_of,
    of_scene,
    refuse_shared,
    remember,
    rows_kept,
    state_of_files,
)
from engine.command_line.batch import read_scene_table
from engine.command_line.main import make_parser
from engine.job import LiftRequest, write_atomically
from engine.job.manifest import write_manifest
from engine.job.own_files import NOTE, OwnFiles
from tests.raises_key import raises_key


@pytest.mark.parametrize("name", ["...zip", "..zip", ".batch.zip", "table.md.zip", "Table.CSV.zip"])
def test_a_scene_name_that_would_leave_the_output_folder_is_refused(name: str, tmp_path: Path) -> None:
    (tmp_path / name).touch()
    with raises_key("names-clash|scene-unnamable"):
        names_of([tmp_path / name])


@pytest.mark.parametrize("other", ["y/room", "y/Room", "y/ROOM.zip"])
def test_two_scenes_of_the_same_name_are_refused(other: str, tmp_path: Path) -> None:
    for scene in (tmp_path / "x" / "room", tmp_path / other):
        scene.mkdir(parents=True) if not scene.suffix else (scene.parent.mkdir(), scene.touch())
    with raises_key("names-clash"):
        names_of([tmp_path / "x" / "room", tmp_path / other])
    assert names_of([tmp_path / "x" / "room", tmp_path / other], ["", "room-y"]) == ["room", "room-y"]


def test_scenes_given_as_dot_dot_paths_are_named_after_their_real_folders(tmp_path: Path) -> None:
    (tmp_path / "a" / "-o").mkdir(parents=True)
    assert names_of([tmp_path / "a" / "-o" / ".." / "-o", tmp_path / "a" / "-o" / ".."]) == ["-o", "a"]


@pytest.mark.parametrize("lost", ["result/passes/0001.exr", "exports/ply", f"exports/ply/{NOTE}"])
def test_a_scene_without_its_result_files_does_not_count_as_done(lost: str, tmp_path: Path) -> None:
    job = SceneJob("room", tmp_path / "room", LiftRequest(scene=tmp_path / "scene"))
    plan = BatchPlan(tmp_path, (job,), exports=("ply",))
    passes = job.lift / "result/passes/0001.exr"
    passes.parent.mkdir(parents=True)
    passes.write_text("all of it")
    with OwnFiles(job.lift / "exports/ply").begin("export", {}) as own:
        write_atomically(job.lift / "exports/ply/splats.ply", "all of it")
    own.complete()
    write_manifest(job.lift / "result", versions={}, seed=0, settings={}, timings={})
    row = Row("room", "done", 1.0, "", 0, {})
    remember(plan, job, row)
    assert done_before(plan, job) == row
    path = job.lift / lost
    shutil.rmtree(path) if path.is_dir() else path.write_text("half")
    assert done_before(plan, job) is None


@pytest.mark.parametrize(
    "touched", ["scene/panoptic.json", "scene/linked/0001.png", "masks/table/0001.png", "names.toml"]
)
def test_a_changed_file_makes_the_batch_check_its_scene_again(touched: str, tmp_path: Path) -> None:
    """What an earlier batch noted as done counted, whatever had become of the masks."""
    for name in ("scene/panoptic.json", "elsewhere/0001.png", "masks/table/0001.png", "masks/table.json", "names.toml"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("made")
    (tmp_path / "scene" / "linked").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "elsewhere" / "again").symlink_to(tmp_path / "scene")
    masks, classes = tmp_path / "masks" / "table.json", str(tmp_path / "names.toml")
    request = LiftRequest(scene=tmp_path / "scene", masks=masks, classes=classes)
    write_manifest(tmp_path / "room" / "result", versions={}, seed=0, settings={}, timings={})

    def job() -> SceneJob:
        return SceneJob("room", tmp_path / "room", request, files=state_of_files(request, tmp_path / "out"))

    plan, row = BatchPlan(tmp_path, (job(),)), Row("room", "done", 1.0, "", 0, {})
    remember(plan, job(), row)
    assert done_before(plan, job()) == row
    (tmp_path / touched).write_text("made anew")
    assert done_before(plan, job()) is None


def _changes_its_state(touched: str, request: LiftRequest, folder: Path) -> bool:
    """Whether the state of a scene's files is another one after a file in ``folder`` is written; OUT is in a scene."""
    before = state_of_files(request, folder / "scene" / "OUT")
    (folder / touched).parent.mkdir(parents=True, exist_ok=True)
    (folder / touched).write_text("made anew")
    return state_of_files(request, folder / "scene" / "OUT") != before


@pytest.mark.parametrize(
    ("touched", "is_read"),
    [
        ("preds.json", True),
        ("preds/0001.png", True),
        ("classes.toml", True),
        ("other.json", False),
        ("coco/a.png", False),
    ],
)
def test_changed_masks_redo_lifts(touched: str, is_read: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The whole folder around the mask file, or a folder named like the class table, does not count."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene").mkdir()
    (tmp_path / "preds.json").write_text("{}")
    request = LiftRequest(scene=tmp_path / "scene", masks=tmp_path / "preds.json", classes="coco")
    assert _changes_its_state(touched, request, tmp_path) is is_read


@pytest.mark.parametrize(
    ("scene", "touched", "is_read"),
    [
        ("transforms.json", "images/0001.png", True),
        ("transforms.json", "OUT/table.csv", False),
        ("room.r3d", "images/0001.png", False),
        ("room.sens", "room/splits.json", True),
    ],
)
def test_changed_photos_make_a_batch_redo_a_scene(scene: str, touched: str, is_read: bool, tmp_path: Path) -> None:
    """Of a transforms.json neither its photos nor its depth were seen. Other scans lie beside one in an archive."""
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / scene).write_text("{}")
    request = LiftRequest(scene=tmp_path / "scene" / scene)
    assert _changes_its_state(f"scene/{touched}", request, tmp_path) is is_read


@pytest.mark.parametrize("touched", ["Thumbs.db", ".DS_Store", ".git/index", "lift/result/a.exr", "OUT/room/log.txt"])
def test_files_that_no_scene_reader_opens_do_not_make_a_batch_redo_a_scene(touched: str, tmp_path: Path) -> None:
    """A file that a system wrote, or the results of a lift or of the batch, had exports and scores written again."""
    for lift in ("scene", "scene/lift"):  # the scene itself counts, whatever is in it
        (tmp_path / lift).mkdir()
        (tmp_path / lift / "request.json").write_text("{}")
    request = LiftRequest(scene=tmp_path / "scene")
    assert not _changes_its_state(f"scene/{touched}", request, tmp_path)
    assert _changes_its_state("scene/rgb/0001.png", request, tmp_path)


def test_a_scene_given_as_a_link_is_named_after_the_link(tmp_path: Path) -> None:
    """Data sets are often links to folders that are all called alike."""
    links = []
    for name in ("one", "two"):
        (tmp_path / name / "frames").mkdir(parents=True)
        links.append(tmp_path / f"scene-{name}")
        links[-1].symlink_to(tmp_path / name / "frames")
    assert names_of(links) == ["scene-one", "scene-two"]
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    assert names_of([loop]) == ["loop"]  # its lift says what is wrong
    with raises_key("scene-twice scene-one"):
        names_of([links[0], tmp_path / "one" / ".." / "one" / "frames"])


@pytest.mark.parametrize("name", ["two\nlines", "\x1b[31mred", 300 * "x", "a/b", "..", "C:x", "\udcff"])
def test_a_scene_name_that_cannot_be_a_folder_name_is_refused(name: str) -> None:
    with raises_key("scene-unnamable") as error:
        names_of([Path("scene")], [name])
    assert "\n" not in str(error.value)


def test_one_masks_path_for_several_scenes_is_refused() -> None:
    refuse_shared("--masks", Path("masks"), 1)
    refuse_shared("--masks", Path("masks/{scene}"), 2)
    with raises_key("shared-path --masks masks {scene}"):
        refuse_shared("--masks", Path("masks"), 2)
    assert of_scene(Path("masks/{scene}.json"), "room") == Path("masks/room.json")


def test_the_batch_table_keeps_rows_of_earlier_scenes_that_still_exist(tmp_path: Path) -> None:
    jobs = {}
    for name in ("corrected", "deleted", "done", "failed", "failed and gone"):
        (tmp_path / f"{name}.scene").touch()
        jobs[name] = job = SceneJob(name, tmp_path / name, LiftRequest(scene=tmp_path / f"{name}.scene"))
        if "failed" not in name:
            (job.lift / "result").mkdir(parents=True)
            write_manifest(job.lift / "result", versions={"code": "abc"}, seed=0, settings={}, timings={})
        state = "failed" if "failed" in name else "done"
        remember(BatchPlan(tmp_path, (job,)), job, Row(name, state, 1.0, "", 0, {}, lifting_code(job.lift)))
    (tmp_path / "corrected" / "corrections.json").write_text("{}")
    shutil.rmtree(tmp_path / "deleted")
    (tmp_path / "failed and gone.scene").unlink()
    plan = BatchPlan(tmp_path, (SceneJob("new", tmp_path / "new", LiftRequest(scene=tmp_path)),))
    kept = [(row.scene, row.state, row.code) for row in rows_kept(plan)]
    assert kept == [("corrected", "changed", "abc"), ("done", "done", "abc"), ("failed", "failed", "")]
    assert [row.scene for row in rows_kept(BatchPlan(tmp_path, (jobs["done"],)))] == ["corrected", "failed"]


def options_of(folder: Path, name: str, text: str, *command: str) -> list[argparse.Namespace]:
    (folder / name).write_text(text, encoding="utf-8")
    options = make_parser().parse_args(["batch", "--scenes", str(folder / name), "-o", "out", *command])
    return read_scene_table(folder / name, options)


CSV = """\
scene,name,up,masks,mask_format,set,fit,classes
scans/office,,,,,,,
/data/kitchen,"kitchen, old",-y,masks/k,coco,voxel_size=0.1,yes,coco.toml
"""
TOML = """
[[scene]]
scene = "scans/office"
[[scene]]
scene = "/data/kitchen"
name = "kitchen, old"
up = "-y"
masks = "masks/k"
mask-format = "coco"
set = ["voxel_size=0.1"]
fit = true
classes = "coco.toml"
"""


@pytest.mark.parametrize(("name", "text"), [("scans.csv", "\ufeff" + CSV), ("scans.toml", TOML)])
def test_each_scene_has_its_own_options(name: str, text: str, tmp_path: Path) -> None:
    office, kitchen = options_of(tmp_path, name, text, "--up", "y", "--seed", "3", "--set", "majority=0.6")
    assert (office.scene, office.scene_name, office.up) == (tmp_path / "scans/office", "", "y")
    assert (kitchen.scene, kitchen.scene_name, kitchen.up) == (Path("/data/kitchen"), "kitchen, old", "-y")
    assert (office.seed, kitchen.seed, office.masks, kitchen.masks) == (3, 3, None, tmp_path / "masks/k")
    assert (office.set, kitchen.set) == (["majority=0.6"], ["majority=0.6", "voxel_size=0.1"])
    assert (office.fit, kitchen.fit, kitchen.classes) == (None, True, str(tmp_path / "coco.toml"))


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("t.csv", "scene,up\na,y\nb,sideways\n", "* t.csv scene 2"),
        ("t.csv", "scene,colour\na,red\n", "row-option --colour=red"),
        ("t.csv", "name,up\na,y\n", "row-without-scene"),
        ("t.csv", "scene,bake\na,all\n", "option-of-all bake"),
        ("t.csv", "", "empty-scene-table"),
        ("t.csv", "scene\na,b,c\n", "* t.csv"),
        ("t.toml", "scene = 'a'", "not-scene-table"),
        ("t.toml", "[[scene]]\nscene = {}", "* t.toml scene 1"),
        ("t.toml", "[[scene]\n", "not-scene-table"),
    ],
)
def test_a_bad_table_of_scenes_gives_a_one_line_error(name: str, text: str, said: str, tmp_path: Path) -> None:
    with raises_key(said) as error:
        options_of(tmp_path, name, text)
    assert "\n" not in str(error.value)
