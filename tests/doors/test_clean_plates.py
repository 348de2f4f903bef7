"""What docs/clean-plates.md promises, done as it says, in the tiny room: a cabinet and a chair on the floor."""

import hashlib
import json
import os
import re
import shutil
import socket
import subprocess
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest

import engine
from engine import plates
from engine.command_line.main import main
from engine.corrections import MadeResult, correct, making, read_corrected, undo
from engine.corrections.edits import Edit, editing, read_edits
from engine.corrections.fills import NOTHING, Fill, path_of, read_fill, write_fill
from engine.errors import PlgsError
from engine.job import ExitCode, LiftFolder, LiftRequest
from engine.lift_arrays import Gaussians
from engine.passes.exr import PanopticLayers, read_exr, read_note
from engine.plates.completion import complete, completed_labels
from engine.plates.leaving import Leaving, other_points
from engine.plates.planes import Plane, find_planes
from engine.plates.texture import Texture
from engine.plates.views import frames_around
from engine.scene import open_scene
from tests import tiny_scene
from tests.doors.terminal import ROOT, Terminal
from tests.raises_key import raises_key
from tests.tiny_scene import CABINET, CHAIR, CHAIR_ID, FLOOR_ID, PAINT, TinyView, tiny_intrinsics, tiny_pose, trace_view
from tests.train.tiny_lift import TINY, lift_into, presets_as, warnings_in

LIFT = "lifts/demo"
REMOVE = ".venv/bin/python -m engine correct lifts/demo remove 7"
BAKE = ".venv/bin/python -m engine bake lifts/demo --frames test --layers normal position vector"
PLATE = ".venv/bin/python -m engine bake lifts/demo --frames test --without 7 -o plate"
PUT_BACK = ".venv/bin/python -m engine correct lifts/demo put-back 7"
LIST = ".venv/bin/python -m engine correct lifts/demo list"


@pytest.fixture(scope="module")
def removed(lifted: Path, tmp_path_factory: pytest.TempPathFactory, quick_python: Path) -> Terminal:
    """A terminal in whose lift the chair was removed, and the held-out frame baked again."""
    folder = tmp_path_factory.mktemp("removed") / "clone"
    shutil.copytree(lifted, folder)
    terminal = Terminal.like_a_clone(folder, quick_python)
    shutil.copytree(folder / LIFT, folder / "lifts/before")
    terminal.run(REMOVE, id7=chair(terminal))
    terminal.run(BAKE)
    return terminal


def chair(terminal: Terminal, lift: str = LIFT) -> int:
    return next(one.id for one in engine.read_lift(terminal.folder / lift).instances if one.class_id == CHAIR_ID)


def passes(folder: Path) -> Path:
    [path] = folder.rglob("*.exr")
    return path


def planes(path: Path) -> dict[str, np.ndarray]:
    return {name: each.pixels for name, each in OpenEXR.File(str(path), separate_channels=True).channels().items()}


def is_hidden(eye: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Whether the chair or the cabinet stands between an eye [3] and each place [..., 3]."""
    way = np.where(np.abs(place - eye) < 1e-9, 1e-9, place - eye)
    sides = [(box - eye) / way[..., None, :] for box in (CHAIR, CABINET)]
    return np.any([each.min(-2).max(-1).clip(0) < each.max(-2).min(-1).clip(None, 0.98) for each in sides], axis=0)


def before_and_after(terminal: Terminal) -> tuple[PanopticLayers, PanopticLayers, np.ndarray]:
    """Both passes, and where the chair was."""
    both = [read_exr(passes(terminal.folder / lift / "result" / "passes")) for lift in ("lifts/before", LIFT)]
    return both[0], both[1], both[0].instance == chair(terminal, "lifts/before")


def test_no_pixel_of_a_bake_shows_a_removed_object(removed: Terminal) -> None:
    before, after, was = before_and_after(removed)
    number = chair(removed, "lifts/before")
    assert was.any() and number not in after.instance and CHAIR_ID not in after.semantic
    channels = planes(passes(removed.folder / LIFT / "result/passes"))
    assert b"chair 1" not in passes(removed.folder / LIFT / "result/passes").read_bytes().split(b"plgs/removed")[0]
    assert not {name for name, plane in channels.items() if not np.isfinite(plane).all()}


def test_passes_show_the_floor_behind_a_removed_object(removed: Terminal) -> None:
    before, after, was = before_and_after(removed)
    assert (after.combined[..., 3][was] > 0.8).mean() > 0.9, "the hole is filled"
    assert (after.semantic[was] == FLOOR_ID).mean() > 0.4 and (after.semantic[was] > 0).all()
    assert np.median(after.depth[was]) > np.median(before.depth[was]), "what is behind is farther away"
    channels = planes(passes(removed.folder / LIFT / "result/passes"))
    floor = was & (after.semantic == FLOOR_ID)
    assert np.median(channels["PLGS.Normal.Z"][floor].astype(float)) > 0.9
    assert np.abs(np.median(channels["PLGS.Position.Z"][floor])) < 0.05
    assert np.abs(after.combined[~was] - before.combined[~was]).mean() < 0.01, "elsewhere little changes"


def test_a_filled_hole_has_the_colours_of_the_empty_room(removed: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    _, after, was = before_and_after(removed)
    [frame] = open_scene(removed.folder / "scans/room").test_frames
    height, width = was.shape
    monkeypatch.setattr(tiny_scene, "CHAIR", CHAIR + 50)
    truth = trace_view(frame.camera.camera_to_world, tiny_intrinsics((width, height)), (width, height)).colour / 255.0
    shown = np.clip(after.combined[..., :3], 0, None) ** (1 / 2.2)
    channels = planes(passes(removed.folder / LIFT / "result/passes"))
    guessed = channels["PLGS.Guessed.V"].astype(float)
    for what in (was & (guessed < 0.1), was & (guessed > 0.9)):
        assert what.sum() > 100 and np.abs(shown - truth)[what].mean() < 0.08
        assert np.abs(shown[what].mean(axis=0) - truth[what].mean(axis=0)).max() < 0.04, "as bright"


def contrast(xyz: np.ndarray, rgb: np.ndarray) -> np.ndarray:
    """The deviation of colours [N, 3] from the mean of four tiles of the chessboard, whatever the light is."""
    four = np.unique(np.floor(xyz[:, :2] / 0.5), axis=0, return_inverse=True)[1].ravel()
    mean = np.stack([np.bincount(four, each) for each in rgb.T], axis=1) / np.bincount(four)[:, None]
    return (rgb - mean[four]).std(axis=0)


def test_guessed_points_have_the_mean_colour_of_the_floor_without_its_pattern(removed: Terminal) -> None:
    [edit] = json.loads((removed.folder / LIFT / "corrections.json").read_text())["edits"]
    fill = read_fill(path_of(removed.folder / LIFT, edit["fill"]))
    floor = fill.label == -FLOOR_ID
    is_seen, is_guessed = floor & (fill.guessed == 0), floor & (fill.guessed > 0)
    assert is_seen.sum() > 100 and is_guessed.sum() > 100
    assert np.abs(fill.rgb[is_seen].mean(axis=0) - fill.rgb[is_guessed].mean(axis=0)).max() < 0.03
    seen, guessed = (contrast(fill.xyz[where], fill.rgb[where]) for where in (is_seen, is_guessed))
    assert (guessed < 0.4 * seen).all(), "the floor is a chessboard"


def test_a_rug_keeps_its_straight_edges_under_a_filled_hole() -> None:
    rug, floor, hole = 9, 2, np.zeros((60, 80), bool)
    truth = np.full(hole.shape, -floor, np.int32)
    truth[15:45, 10:50] = -rug
    hole[30:55, 35:65] = True  # which has one of the rug's corners
    seen = np.where(hole, 0, truth).astype(np.int32)
    assert np.array_equal(completed_labels(seen, hole, ~hole), truth)


FRAMES, LEG_HEIGHT = 8, 0.3


def places(view: TinyView, pose: np.ndarray) -> np.ndarray:
    """What each pixel of a view shows, in the world [H, W, 3]."""
    height, width = view.depth.shape
    focal, _, x, _, _, y = tiny_intrinsics((width, height))[:2].ravel()
    row, column = np.mgrid[:height, :width] + 0.5
    rays = np.stack([(column - x) / focal, (row - y) / focal, np.ones_like(row)], axis=-1)
    return (rays * view.depth[..., None]) @ pose[:3, :3].T + pose[:3, 3]


def from_chair(xyz: np.ndarray) -> np.ndarray:
    """Metres along the floor from the chair [...]."""
    return np.linalg.norm(np.maximum(np.maximum(CHAIR[0] - xyz, xyz - CHAIR[1]), 0)[..., :2], axis=-1)


def light(xyz: np.ndarray) -> np.ndarray:
    """The share of the light that the chair lets through to the floor [...]."""
    return 1 - 0.6 * np.exp(-from_chair(xyz) / 0.2)


def with_shadow(view: TinyView, pose: np.ndarray) -> TinyView:
    left = np.where(view.semantic == FLOOR_ID, light(places(view, pose)), 1)
    return replace(view, colour=(view.colour * left[..., None]).astype(np.uint8))


def without_legs(view: TinyView, number: int) -> TinyView:
    """As masks that call the chair's lower part floor."""
    legs = (view.instance == 1) & (places(view, tiny_pose(number, FRAMES))[..., 2] < LEG_HEIGHT)
    semantic, instance = np.where(legs, FLOOR_ID, view.semantic), np.where(legs, 0, view.instance)
    return replace(view, semantic=semantic.astype(np.int32), instance=instance.astype(np.int32))


@pytest.fixture(scope="module")
def shadowed(tmp_path_factory: pytest.TempPathFactory) -> list[Gaussians]:
    """The Gaussians before and after the removal, without a network, of a chair with a shadow and without legs."""

    def refuse(*_: object) -> None:
        raise AssertionError("a removal asked the network")

    folder = tmp_path_factory.mktemp("shadowed")
    scene = tiny_scene.write_tiny_scene(folder / "room", frames=FRAMES, shown=with_shadow, seen=without_legs)
    with presets_as(preview=TINY):
        lift = lift_into(folder / "lift", LiftRequest(scene=scene, bake="none"))
    before = engine.read_lift(lift.path).gaussians
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(socket.socket, "connect", refuse)
        patch.setattr(socket, "getaddrinfo", refuse)
        plates.remove(lift, ["chair 1"])
    return [before, engine.read_lift(lift.path).gaussians]


def test_a_rug_that_is_a_thing_goes_on_under_what_stood_on_it(tmp_path: Path) -> None:
    rug_id, (low, high) = 9, (CHAIR[0] - 0.3, CHAIR[1] + 0.3)

    def with_rug(view: TinyView, pose: np.ndarray) -> TinyView:
        xyz = places(view, pose)
        rug = (view.semantic == FLOOR_ID) & ((xyz > low) & (xyz < high))[..., :2].all(axis=-1)
        semantic, instance = np.where(rug, rug_id, view.semantic), np.where(rug, 3, view.instance)
        return replace(view, semantic=semantic.astype(np.int32), instance=instance.astype(np.int32))

    scene = tiny_scene.write_tiny_scene(
        tmp_path / "room", frames=FRAMES, shown=with_rug,
        categories=[*tiny_scene.CATEGORIES, {"id": rug_id, "name": "rug", "isthing": 1}],
    )  # fmt: skip
    with presets_as(preview=TINY):
        lift = lift_into(tmp_path / "lift", LiftRequest(scene=scene, bake="none"))
    told = list[str]()
    plates.remove(lift, ["chair 1"], tell=told.append)
    shown = engine.read_lift(lift.path).gaussians
    below = (np.abs(shown.xyz - [1.5, 1.3, 0.0]) < [0.25, 0.25, 0.03]).all(axis=1)
    assert told == [] and below.sum() > 500 and (shown.class_id[below] == rug_id).mean() > 0.8


def test_what_is_guessed_is_never_brighter_than_what_photos_saw() -> None:
    """A wall that grows brighter towards a hole at its end, beyond which photos saw only a narrow strip."""
    seen = np.ones((60, 80), bool)
    seen[2:-2, 30:-2] = False
    x = np.arange(80) / 80
    colour = np.broadcast_to((0.1 * np.exp(4 * x) * (x < 0.4) + 0.3 * (x > 0.4))[None, :, None], (60, 80, 3))
    flat, nowhere = Plane(np.zeros(3), np.eye(3)), np.zeros_like(seen)
    label, inside = np.full(seen.shape, -FLOOR_ID, np.int32), np.ones_like(seen)
    wall = Texture(
        flat, np.zeros(2), 0.02, colour.astype(np.float32), seen, ~seen, label, inside, nowhere, poorly=nowhere
    )
    done = complete(wall, Leaving.of(np.full((9, 3), 5.0)), np.zeros((0, 3)))
    assert done is not None and done.hole.sum() > 2000
    assert 0.2 < done.colour[done.hole].min() and done.colour[done.hole].max() <= colour[:, :30].max()


def test_a_change_of_paint_on_a_wall_goes_on_behind_a_removed_picture() -> None:
    colour = np.full((60, 80, 3), 0.6, np.float32)
    colour[:30] = 0.3  # the lower half, as rows go up
    hidden = np.zeros((60, 80), bool)
    hidden[15:45, 20:60] = True
    upright = Plane(np.zeros(3), np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]))
    label, nowhere = np.where(hidden, 0, -FLOOR_ID).astype(np.int32), np.zeros_like(hidden)
    wall = Texture(
        upright, np.zeros(2), 0.02, np.where(hidden[..., None], 0, colour).astype(np.float32), ~hidden, hidden, label,
        np.ones_like(hidden), nowhere, poorly=nowhere,
    )  # fmt: skip
    done = complete(wall, Leaving.of(np.full((9, 3), 5.0)), np.zeros((0, 3)))
    assert done is not None and np.abs(done.colour - colour)[hidden].max() < 0.03


def test_a_noisy_floor_is_one_plane_and_a_step_is_another() -> None:
    random = np.random.default_rng(0)
    floor = random.uniform([0, 0, 0], [4, 4, 0], (60000, 3)) + random.normal(0, 0.016, (60000, 1)) * [0, 0, 1]
    step = random.uniform([2, 2, 0.05], [3, 3, 0.05], (6000, 3)) + random.normal(0, 0.003, (6000, 1)) * [0, 0, 1]
    up = np.array([0.0, 0.0, 1.0])
    [plane] = find_planes(floor, np.broadcast_to(up, floor.shape))
    assert abs(plane.origin[2]) < 0.01
    both = np.concatenate([floor[:20000] * [1, 1, 0.1], step])
    assert len(find_planes(both, np.broadcast_to(up, both.shape))) == 2


def test_a_ceiling_goes_on_where_a_lamp_was_removed() -> None:
    hidden = np.zeros((60, 80), bool)
    hidden[20:40, 30:50] = True
    down = Plane(np.array([0.0, 0.0, 2.5]), np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]))
    label, nowhere = np.where(hidden, 0, -FLOOR_ID).astype(np.int32), np.zeros_like(hidden)
    colour = np.where(hidden[..., None], 0, np.full((60, 80, 3), 0.6)).astype(np.float32)
    ceiling = Texture(
        down, np.zeros(2), 0.02, colour, ~hidden, hidden, label, np.ones_like(hidden), nowhere, poorly=nowhere
    )
    lamp = np.random.default_rng(0).uniform([0.6, -0.8, 2.1], [1.0, -0.4, 2.5], (900, 3))
    done = complete(ceiling, Leaving.of(lamp), np.zeros((0, 3)))
    assert done is not None and np.abs(done.colour - 0.6)[hidden].max() < 0.05


def test_a_photo_of_a_small_part_of_a_large_object_helps_to_remove_it(lifted: Path) -> None:
    frame = open_scene(lifted / "scans/room").train_frames[0]
    near = replace(frame, camera=replace(frame.camera, fx=40 * frame.camera.fx, fy=40 * frame.camera.fy))
    part = near.camera.centre + 2 * near.camera.camera_to_world[:3, 2]
    around = part + np.array([[-3.1, -3.3, -3.7], [2.9, 3.1, 3.3]])
    assert frames_around([near], around) == [] and frames_around([near], np.vstack([around, part])) == [near]
    assert not len(other_points([], Leaving.of(around)).xyz)


def test_removing_an_object_removes_its_shadow(shadowed: list[Gaussians]) -> None:
    after, lit = shadowed[1], 0.875 * PAINT[FLOOR_ID].mean() / 255  # the chessboard's mean
    near = (np.abs(after.xyz[:, 2]) < 0.05) & (after.class_id == FLOOR_ID) & (from_chair(after.xyz) < 0.1)
    assert near.sum() > 100 and light(after.xyz[near]).mean() < 0.6, "in the photos"
    assert after.rgb[near].mean() > 0.8 * lit  # with the shadow that is beside it: 0.74


def test_removing_a_chair_removes_legs_that_the_masks_missed(shadowed: list[Gaussians]) -> None:
    low, high = [*CHAIR[0, :2] - 0.05, 0.1], [*CHAIR[1, :2] + 0.05, LEG_HEIGHT]
    before, after = (((one.xyz > low) & (one.xyz < high)).all(axis=1) for one in shadowed)
    assert before.sum() > 10 and (shadowed[0].class_id[before] == FLOOR_ID).mean() > 0.5 and not after.any()


def test_the_pass_guessed_is_1_where_no_photo_saw_the_surface(removed: Terminal) -> None:
    guessed = planes(passes(removed.folder / LIFT / "result/passes"))["PLGS.Guessed.V"].astype(float)
    _, after, was = before_and_after(removed)
    assert guessed.min() >= 0 and guessed.max() <= 1 and guessed[was].max() > 0.9
    channels = planes(passes(removed.folder / LIFT / "result/passes"))
    place = np.stack([channels[f"PLGS.Position.{axis}"] for axis in "XYZ"], axis=-1)
    never = np.ones(guessed.shape, bool)
    for frame in open_scene(removed.folder / "scans/room").train_frames:
        inside = np.zeros(guessed.size, bool)
        inside[frame.camera.seen(place.reshape(-1, 3))[0]] = True
        never &= ~inside.reshape(guessed.shape) | is_hidden(frame.camera.centre, place)
    assert never.sum() > 100
    assert never[guessed < 0.1].mean() < 0.03, "nothing is invented in silence"
    assert never[guessed > 0.9].mean() > 0.4, "the rim of the object's mask is not trusted, either"
    is_empty = channels["PLGS.Combined.A"] < 0.5
    assert (guessed[is_empty] > 0.45).all(), "nor is anything empty in silence"
    before = planes(passes(removed.folder / "lifts/before/result/passes"))
    assert "PLGS.Guessed.V" not in before


def test_the_header_names_what_was_removed(removed: Terminal) -> None:
    assert read_note(passes(removed.folder / LIFT / "result/passes"), "plgs/removed") == "chair 1"


def test_the_points_that_fill_a_hole_are_stored_in_the_lift(removed: Terminal) -> None:
    [fill] = (removed.folder / LIFT / "fills").iterdir()
    [edit] = json.loads((removed.folder / LIFT / "corrections.json").read_text())["edits"]
    assert edit["kind"] == "remove" and edit["fill"] == fill.stem


def test_points_and_splats_in_blender_lack_a_removed_object(removed: Terminal) -> None:
    lift, number = engine.read_lift(removed.folder / LIFT), chair(removed, "lifts/before")
    for found in (lift.points, lift.gaussians):
        assert number not in found.instance_id
        above = ((found.xyz > [*CHAIR[0, :2], 0.2]) & (found.xyz < [*CHAIR[1, :2], 0.9])).all(axis=1)
        below = ((found.xyz > [*CHAIR[0, :2], -0.1]) & (found.xyz < [*CHAIR[1, :2], 0.1])).all(axis=1)
        assert below.sum() > 20 and above.sum() < 0.1 * below.sum()
        assert (found.class_id[below] == FLOOR_ID).mean() > 0.9
    removed.run(".venv/bin/python -m engine export lifts/demo --to splats -o out/splats")
    assert number not in [
        one["id"] for one in json.loads((removed.folder / "out/splats/labels.json").read_text())["instances"]
    ]


def test_bake_without_an_object_writes_one_plate_and_no_correction(terminal: Terminal) -> None:
    number, lift = chair(terminal), terminal.folder / LIFT
    shown = passes(lift / "result/passes").read_bytes()
    terminal.run(PLATE, id7=number)
    assert number not in read_exr(passes(terminal.folder / "plate")).instance
    assert passes(lift / "result/passes").read_bytes() == shown and not (lift / "corrections.json").exists()
    assert chair(terminal) == number
    said = terminal.run(PLATE.removesuffix(" -o plate"), code=2, id7=number)
    assert "Give a folder" in said


def test_put_back_restores_an_object_and_list_names_removed_ones(terminal: Terminal) -> None:
    number, baked = chair(terminal), planes(passes(terminal.folder / LIFT / "result/passes"))
    terminal.run(REMOVE, id7=number)
    assert "(removed)" in terminal.run(LIST)
    terminal.run(PUT_BACK, id7=number)
    assert chair(terminal) == number and "(removed)" not in terminal.run(LIST)
    terminal.run(REMOVE.replace("7", '"chair 1"'))
    shutil.rmtree(terminal.folder / "scans")
    terminal.run(BAKE)
    assert number not in read_exr(passes(terminal.folder / LIFT / "result/passes")).instance, "photos may be gone"
    terminal.run(PUT_BACK, id7=number)
    terminal.run(BAKE)
    now = planes(passes(terminal.folder / LIFT / "result/passes"))
    assert all(np.array_equal(now[name], plane) for name, plane in baked.items()), "passes show what they showed"


def test_one_command_removes_several_objects(terminal: Terminal) -> None:
    before = read_exr(passes(terminal.folder / LIFT / "result/passes"))
    numbers = [one.id for one in engine.read_lift(terminal.folder / LIFT).instances]
    assert len(numbers) > 1
    terminal.run(REMOVE.replace("7", " ".join(map(str, numbers))))
    terminal.run(BAKE)
    shown = read_exr(passes(terminal.folder / LIFT / "result/passes"))
    assert not shown.instance.any() and (shown.combined[..., 3][before.instance > 0] > 0.5).mean() > 0.8


def shows_the_chair(export: Path, form: str) -> bool:
    """Whether an export has it, in a segment, a picture, a prim, a file's name or its bytes."""
    if form == "coco":
        annotations = json.loads((export / "panoptic.json").read_text())["annotations"]
        return CHAIR_ID in {one["category_id"] for each in annotations for one in each["segments_info"]}
    if form == "surface":
        return bool([*export.glob(f"pictures/{CHAIR_ID}_*")])
    if form == "usd":
        stage = pytest.importorskip("pxr.Usd").Stage.Open(str(export / "lift.usdc"))
        return "chair 1" in {prim.GetDisplayName() for prim in stage.Traverse()}
    files = [path for path in export.rglob("*") if path.is_file()]
    return any(name in path.name or name.encode() in path.read_bytes() for path in files for name in SPELLED)


SPELLED = ("chair 1", "chair_1", "chair-1")


@pytest.mark.parametrize("form", ["coco", "surface", "mesh", "gltf", "usd"])
def test_no_export_contains_a_removed_object(removed: Terminal, form: str) -> None:
    for lift, is_shown in (("lifts/before", True), (LIFT, False)):
        removed.run(f".venv/bin/python -m engine export {lift} --to {form} -o {lift}-{form}")
        assert shows_the_chair(removed.folder / f"{lift}-{form}", form) == is_shown


def test_a_removal_tells_which_photos_are_gone(terminal: Terminal) -> None:
    terminal.run(".venv/bin/python -m engine find-scene lifts/demo scans/room")
    for file in (terminal.folder / "scans/room").glob("*/0001.*"):
        file.unlink()
    said = terminal.run(REMOVE, id7=chair(terminal))
    assert "warning: the scene no longer has frame 0001: what only it showed is guessed" in said


def test_evaluate_warns_that_the_ground_truth_shows_a_removed_object(removed: Terminal) -> None:
    said = removed.run(".venv/bin/python -m engine evaluate lifts/demo --classes")
    assert re.search(r"the ground truth still shows what was removed: chair 1", said)
    assert re.search(r"^lifted, strict(.*\n)*?chair +0\.0 ", said, re.MULTILINE)


KILLED = """
import os, signal, sys
from pathlib import Path
from engine.job import LiftFolder
from engine.plates import removal
def die(*_):
    os.kill(os.getpid(), signal.SIGKILL)
def watch(done, of):
    if moment == "computing" and 2 * done > of:
        die()
moment, lift, chair = sys.argv[1:]
if moment == "writing":
    removal.correct = die
removal.remove(LiftFolder.open(Path(lift)), [chair], watch)
"""


@pytest.mark.parametrize("moment", ["computing", "writing"])
def test_a_removal_that_was_killed_changes_nothing_and_can_be_made_again(
    terminal: Terminal, quick_python: Path, moment: str
) -> None:
    number, lift = chair(terminal), terminal.folder / LIFT
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    ran = subprocess.run([quick_python, "-c", KILLED, moment, lift, str(number)], env=environment)
    assert ran.returncode and not (lift / "corrections.json").exists() and chair(terminal) == number
    before = {path: path.stat().st_mtime_ns for path in (lift / "fills").glob("*")}
    assert len(before) == (moment == "writing"), "no half of a fill"
    terminal.run(REMOVE, id7=number)
    assert [one.id for one in read_corrected(lift).removed] == [number]
    assert all(path.stat().st_mtime_ns == time for path, time in before.items()), "a whole one is taken as it is"


def test_a_fill_is_not_reused_after_the_engine_changed(terminal: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plates.removal, "fill_of", lambda *_, **__: (NOTHING, []))
    number, folder = str(chair(terminal)), LiftFolder.open(terminal.folder / LIFT)
    names = {plates.remove(folder, [number])[0].fill}
    undo(folder.path)
    monkeypatch.setattr(plates.removal, "code_digest", lambda *_: "of another engine")
    names.add(plates.remove(folder, [number])[0].fill)
    assert len(names) == 2


def test_only_the_last_four_plates_and_used_fills_are_kept(terminal: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plates.removal, "fill_of", lambda *_, **__: (NOTHING, []))
    folder = LiftFolder.open(terminal.folder / LIFT)
    one, other = (str(each.id) for each in engine.read_lift(folder.path).instances)
    for number in range(5):  # names decide about a plate, too
        correct(folder.path, lambda state, _, number=number: making.rename(state, int(other), f"name {number}"))
        plates.without(folder, [one])
    edit, _ = plates.remove(folder, [one])
    undo(folder.path)
    (folder.path / "fills" / "backup.npz").touch()
    plates.without(folder, [other])
    kept = {path.stem for path in (folder.path / "fills").iterdir()}
    assert len(kept) == 6 and {edit.fill, "backup"} < kept


def test_removing_from_a_read_only_lift_is_refused_at_once(terminal: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda *_: False)
    with raises_key("read-only"):
        plates.remove(LiftFolder.open(terminal.folder / LIFT), ["chair 1"], pytest.fail)


QUICK = ["--steps", "8", "--set", "voxel_size=0.2", "--set", "warm_start=false", "--bake", "test"]
LIFT_AGAIN = {
    "lifts/demo": ".venv/bin/python -m engine lift lifts/demo --refine",
    "lifts/next": f".venv/bin/python -m engine lift scans/room -o lifts/next --names-from {LIFT}",
}


@pytest.mark.parametrize("again", LIFT_AGAIN)
def test_a_later_lift_keeps_a_removal_and_makes_its_fill_anew(terminal: Terminal, again: str) -> None:
    lift = terminal.folder / again
    shutil.rmtree(terminal.folder / LIFT)
    terminal.run(".venv/bin/python -m engine lift scans/room -o lifts/demo --preset draft", more=QUICK)
    number = chair(terminal)
    terminal.run(REMOVE, id7=number)
    [edit] = read_edits(terminal.folder / LIFT)
    stale = read_fill(path_of(terminal.folder / LIFT, edit.fill), edit.digest)
    said = terminal.run(LIFT_AGAIN[again], more=QUICK if again != LIFT else [])
    assert "Filling where objects were removed" in (lift / "events.jsonl").read_text() and "put it back" not in said
    baked, kept = passes(lift / "result/passes"), MadeResult.read(lift).fill_of(edit)
    assert read_edits(lift) == (edit,) and not np.array_equal(kept.cells, stale.cells)
    assert read_note(baked, "plgs/removed") == "chair 1" and number not in read_exr(baked).instance
    shown = planes(baked)
    if again != LIFT:
        shutil.rmtree(terminal.folder / LIFT)
    terminal.run(PUT_BACK.replace(LIFT, again), id7=number)
    assert chair(terminal, again) == number
    terminal.run(REMOVE.replace(LIFT, again), id7=number)
    fresh = MadeResult.read(lift).fill_of(read_edits(lift)[1])
    assert all(np.array_equal(each, getattr(kept, name)) for name, each in vars(fresh).items()), "as if removed now"
    terminal.run(BAKE.replace(LIFT, again))
    now = planes(passes(lift / "result/passes"))
    assert all(np.array_equal(now[name], plane) for name, plane in shown.items()), "and so in the picture"


@pytest.mark.parametrize("together", [True, False])
def test_stacked_objects_are_removed_together_or_in_turn(
    together: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    on_it = np.array([[2.4, 1.45, 1.2], [2.9, 1.85, 1.7]])
    monkeypatch.setattr(tiny_scene, "CHAIR", on_it)
    scene = tiny_scene.write_tiny_scene(tmp_path / "room", frames=6)
    with presets_as(preview=TINY):
        lift = lift_into(tmp_path / "lift", LiftRequest(scene=scene, bake="none"))
    listed = engine.read_lift(lift.path).instances
    both = [one.id for one in sorted(listed, key=lambda one: one.class_id == CHAIR_ID)]  # what stands below first
    assert len(both) == 2
    for some in [both] if together else [[one] for one in both]:
        assert main(["correct", str(lift.path), "remove", *map(str, some)]) == 0
    hangs = [f"warning: nothing carries chair 1 any more: perhaps remove them, too ({both[1]})"]
    assert re.findall("warning: .*", "".join(capfd.readouterr())) == ([] if together else hangs)
    edits = json.loads((lift.path / "corrections.json").read_text())["edits"]
    assert all(len(read_fill(path_of(lift.path, edit["fill"])).xyz) > 10000 for edit in edits), "each is filled"
    shown = engine.read_lift(lift.path).gaussians
    assert not np.isin(shown.instance_id, both).any()
    over = ((shown.xyz > [*CABINET[0, :2], 0.1]) & (shown.xyz < [*CABINET[1, :2], 1.7])).all(axis=1)
    floor = ((shown.xyz > [*CABINET[0, :2], -0.1]) & (shown.xyz < [*CABINET[1, :2], 0.1])).all(axis=1)
    assert floor.sum() > 20 and over.sum() < 0.1 * floor.sum()


def refine(lift: LiftFolder) -> int:
    return main(["lift", str(lift.path), "--refine"])


@pytest.fixture
def draft(tmp_path: Path) -> Iterator[LiftFolder]:
    """A draft whose chair and cabinet were removed in turn; a preview is as small."""
    scene = tiny_scene.write_tiny_scene(tmp_path / "room", frames=6)
    with presets_as(draft=replace(TINY, name="draft", trained=0.3), preview=TINY):
        lift = lift_into(tmp_path / "lift", LiftRequest(scene=scene, preset="draft"))
        for name in ("chair 1", "cabinet 1"):
            plates.remove(lift, [name])
        yield lift


def test_fills_are_made_anew_in_their_order_also_after_the_lift_was_stopped(
    draft: LiftFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, calls, fill_of = [fill_in_use(draft, edit) for edit in read_edits(draft.path)], [], plates.removal.fill_of

    def stopped_at_the_second(*given: Any, **named: Any) -> Fill:
        calls.append(given)
        if len(calls) == 2:
            draft.cancel_path.touch()
        return fill_of(*given, **named)

    with monkeypatch.context() as patched:
        patched.setattr(plates.removal, "fill_of", stopped_at_the_second)
        assert refine(draft) == ExitCode.CANCELLED and len(calls) == 2
    edits = read_edits(draft.path)
    assert [fill_in_use(draft, edit) for edit in edits] == before, "the earlier result is as it was"
    assert refine(draft) == 0 and read_edits(draft.path) == edits
    made = [fill_in_use(draft, edit) for edit in edits]
    assert not {*made} & {*before}
    for _ in edits:
        undo(draft.path)
    fresh = [fill_in_use(draft, plates.remove(draft, [name])[0]) for name in ("chair 1", "cabinet 1")]
    assert made == fresh, "as if they were removed from the new lift"


def fill_in_use(lift: LiftFolder, edit: Edit) -> str:
    """What tells a fill from others."""
    fill = MadeResult.read(lift.path).fill_of(edit)
    return hashlib.sha256(b"".join(each.tobytes() for each in vars(fill).values())).hexdigest()


def test_a_fill_that_cannot_be_made_anew_is_told(draft: LiftFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    chair, cabinet = read_edits(draft.path)
    elsewhere = replace(cabinet.objects[0], low=(90.0, 90.0, 90.0), high=(91.0, 91.0, 91.0))
    with editing(draft.path) as edits:
        edits[1:] = replace(cabinet, objects=(elsewhere,)), replace(chair, uid="put back", fill="f0", undone=True)
    write_fill(path_of(draft.path, "f0"), NOTHING)
    before = fill_in_use(draft, chair)

    def gone(*_: object, **__: object) -> Fill:
        correct(draft.path, lambda state, _: making.remove(state, [cabinet.objects[0].id], "f1", digest))
        raise PlgsError("scene-gone", "the scene is not there", draft.path, "")

    digest = write_fill(path_of(draft.path, "f1"), NOTHING)
    monkeypatch.setattr(plates.removal, "fill_of", gone)
    assert refine(draft) == 0 and fill_in_use(draft, chair) == before
    assert not path_of(draft.path, "f0").exists(), "it fits the earlier result"
    told = warnings_in(draft.events_path)[-4:]
    assert "was not applied: object" in told[0] and "remove it by its present name" in told[1]
    assert "in place of chair 1" in told[2] and "the scene is not there: put it back" in told[2]
    assert "in place of cabinet 1" in told[3] and "it was removed while the lift ran: put it back" in told[3]


def test_a_damaged_fill_is_not_taken_over_where_none_can_be_made(
    draft: LiftFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    def gone(*_: object, **__: object) -> Fill:
        raise PlgsError("scene-gone", "the scene is not there", draft.path, "")

    chair, _ = read_edits(draft.path)
    write_fill(path_of(draft.path, chair.fill), NOTHING)
    monkeypatch.setattr(plates.removal, "fill_of", gone)
    assert refine(draft) == 0
    assert "place changed" in read_corrected(draft.path).not_applied[chair.uid], "which its digest shows"


def test_a_removal_of_an_earlier_result_does_not_reach_a_later_one(draft: LiftFolder) -> None:
    path_of(draft.path, undo(draft.path)[0].fill).unlink()  # else it would be used
    before, refined = read_edits(draft.path), list[int]()

    def meanwhile(_done: int, _of: int) -> None:
        if not refined:
            refined.append(refine(draft))

    with raises_key("corrected-meanwhile"):
        plates.remove(draft, ["cabinet 1"], meanwhile)
    assert refined == [0] and read_edits(draft.path) == before
