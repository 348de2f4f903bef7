"""Whatever stands in a file of somebody else's, its reader reads it or refuses it in one line. `READERS` lists them."""

import copy
import io
import itertools
import json
import re
import shutil
import zipfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from engine.command_line.run_engine import run_engine
from engine.corrections import CORRECTIONS, correct, read_corrected
from engine.corrections import making as m
from engine.diagnosis import diagnose
from engine.errors import ErrorCode, PlgsError
from engine.job import EventWriter, LiftFolder, LiftRequest, read_cameras, verify
from engine.job.cameras import LARGEST_SIDE, read_preview_request
from engine.job.recent import recent_lifts, remember_lift
from engine.job.report import metrics_text, read_metrics
from engine.job.terminal import describe
from engine.passes.exr import read_exr, read_note
from engine.passes.ply import columns_of, write_ply_table
from engine.posed.image_header import check_image_file, read_image_header
from engine.posed.ply import read_gaussians
from engine.scene import open_scene
from engine.scene.checks import survey_scene
from engine.scene.formats import FORMATS, find_format
from engine.scene.mask_formats import MASK_FORMATS, find_mask_format
from engine.scene.masks import mask_place
from tests.conftest import HAS_BLENDER
from tests.corrections.two_rooms import CHAIRS, DESK, SOFA, TABLE, write_result
from tests.fuzzing import damaged, examples, places, with_odd_value
from tests.job.following import tiny_lift, watch
from tests.passes.test_exr import write_layers
from tests.scene.formats.test_record3d import lzfse  # noqa: F401 - a fixture
from tests.scene.samples import OPTIONS, WRITERS, look_into, with_content
from tests.tiny_scene import write_tiny_scene

ODD_WORDS = ("nan", "-inf", "1e999", "x", "", "-1", "0", "99999999999999999999", "../a", "\0")
Spoil = Callable[[Any, bytes], bytes]


class Reader(NamedTuple):
    """``write`` fills a folder; one of its ``files`` is spoilt in each of so many ``examples``, and ``read`` refuses it
    with PlgsError or ``allowed``."""

    write: Callable[[Path], object]
    read: Callable[[Path], object]
    files: str = "**/*"
    allowed: tuple[type[Exception], ...] = ()
    examples: int = 8


def odd_word(draw: Any, data: bytes) -> bytes:
    """One number of a text is another word."""
    found = [*re.finditer(rb"-?\d[\d.e+-]*", data)]
    if not found:
        return b""
    number = draw(st.sampled_from(found))
    return data[: number.start()] + draw(st.sampled_from(ODD_WORDS)).encode() + data[number.end() :]


def odd_value(draw: Any, data: bytes) -> bytes:
    """Some values of a JSON document, or of a line that is one, are others; other files are damaged."""
    lines = data.split(b"\n") if data.count(b"\n{") else [data]
    for _ in range(draw(st.integers(1, 3))):
        number = draw(st.integers(0, len(lines) - 1))
        try:
            lines[number] = json.dumps(with_odd_value(draw, json.loads(lines[number]))).encode()
        except ValueError:
            return damaged(draw, data)
    return b"\n".join(lines)


def odd_entry(draw: Any, data: bytes) -> bytes:
    """The head of one file in an archive is damaged, and the archive is whole; other files are damaged."""
    if not zipfile.is_zipfile(io.BytesIO(data)):
        return damaged(draw, data)
    content = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as archive, zipfile.ZipFile(content, "w") as spoilt:
        chosen = draw(st.sampled_from(sorted(archive.namelist())))
        for name in archive.namelist():
            body = archive.read(name)
            spoilt.writestr(name, damaged(draw, body[:200]) + body[200:] if name == chosen else body)
    return content.getvalue()


def write_lift(folder: Path) -> None:
    """A finished lift with one of each file, and the user's list inside."""
    lift = LiftFolder.create(folder / "lift", LiftRequest(scene=Path("/scene"), options={"steps": 7}))
    assert run_engine(lift, lift=tiny_lift) == 0
    lift.checkpoints.save({"step": 1}, lambda into: (into / "model").write_bytes(b"m"))
    wall = {"name": "wall", "iou": 0.5, "tp": 1, "fp": 0, "fn": 2}
    table = {"name": "lifted", "mode": "strict", "miou": 0.5, "psnr": 20.0, "depth_error_m": 0.1, "per_class": [wall]}
    (lift.result_path / "metrics.json").write_text(json.dumps({"format": 1, "tables": [table]}))
    camera = {"name": "shot", "width": 64, "height": 48, "fx": 50, "fy": 50, "cx": 32, "cy": 24, "clip": [0.1, 100],
              "camera_to_world": np.eye(4).tolist()}  # fmt: skip
    (lift.path / "cameras.json").write_text(json.dumps([camera]))
    (lift.path / "preview.json").write_text(json.dumps({**camera, "K": [[50, 0, 32], [0, 50, 24], [0, 0, 1]]}))
    remember_lift(lift.path, lift.path / "cache")
    writer = EventWriter(lift.events_path)
    writer.hello(threads=1, resumed=True)
    writer.stage("train", 1, 2, "Training")
    writer.progress("train", 1, 2, loss=0.5, eta_s=1.0)
    writer.metric("lifted", {"miou": 0.5})
    writer.preview(lift.live_preview_path, "camera")
    writer.error(PlgsError("made-up", "broke", "here", "Mend it.", code=ErrorCode.INTERNAL))
    writer.close()


def read_lift(whole: Path) -> None:
    """All that reads a lift folder."""
    path = whole.parent / "spoilt"
    shutil.rmtree(path, ignore_errors=True)
    shutil.copytree(whole / "lift", path)

    def look_around() -> None:
        folder = LiftFolder.open(path)
        for look in (folder.state, folder.state_at_a_glance, folder.last_exit_code, folder.checkpoints.latest):
            refused_by_a_line(look)
        refused_by_a_line(lambda: verify(folder.result_path))
        refused_by_a_line(lambda: metrics_text(read_metrics(folder), per_class=True).encode())
        follower = watch(folder)
        while follower.is_running:
            follower.poll()
            describe(follower.progress).encode(errors="replace")
        EventWriter(folder.events_path).close()

    refused_by_a_line(look_around)
    refused_by_a_line(lambda: read_preview_request(path / "preview.json"))
    refused_by_a_line(lambda: read_cameras(path / "cameras.json"))
    recent_lifts(path / "cache")


def write_corrections(folder: Path) -> None:
    """A lift with an edit of each kind that has fields of its own."""
    lift = write_result(folder / "lift")
    correct(lift, lambda state, _: m.rename(state, DESK, "Anna's desk"))
    correct(lift, lambda state, _: m.reclass(state, [CHAIRS], SOFA))
    correct(lift, lambda state, first: m.split(state, CHAIRS, m.parts_of(state.points_of(CHAIRS)), first))
    correct(lift, lambda state, _: m.merge(state, [DESK, TABLE]))
    correct(lift, lambda state, _: m.accept(state, [DESK]))


def read_corrections(folder: Path) -> None:
    result = read_corrected(folder / "lift")
    ids = {one.id for one in result.instances}
    assert {*np.unique(result.points.instance_id).tolist()} - {0} <= ids
    assert all(one.name.isprintable() and one.class_name.isprintable() for one in result.instances)
    assert all(line.isprintable() for line in result.warnings)


def write_splats(folder: Path) -> None:
    random = np.random.default_rng(0).normal(size=(6, 14)).astype(np.float32)
    columns = columns_of("x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3", random)
    write_ply_table(folder / "splats.ply", {**columns, "class_id": np.arange(6, dtype=np.int32)})


def read_splats(folder: Path) -> None:
    rows = read_gaussians(folder / "splats.ply")
    assert all(np.isfinite(rows[name]).all() and np.abs(rows[name]).max(initial=0) <= 1e6 for name in "xyz")


def write_images(folder: Path) -> None:
    for suffix in ("png", "jpg"):
        cv2.imwrite(str(folder / f"image.{suffix}"), np.random.default_rng(0).integers(0, 255, (8, 9, 3), np.uint8))


def read_images(folder: Path) -> None:
    for path in folder.iterdir():
        for read in (read_image_header, check_image_file):
            refused_by_a_line(partial(read, path))


def write_passes(folder: Path) -> None:
    write_layers(folder / "a.exr")


def write_blender_lift(folder: Path) -> None:
    from tests.plgs_blender.tiny_lift import write_tiny_lift

    write_tiny_lift(folder / "lift", frames=5, size=(16, 12))


def read_blender_passes(folder: Path) -> None:
    from plgs.plgs_blender import passes

    path = next((folder / "lift" / "result" / "passes").iterdir())
    assert all(0 <= side <= LARGEST_SIDE for side in passes.size_of(path))
    passes.check_layers([path])


def read_blender_lift(folder: Path) -> None:
    """With checksums that fit: somebody made them so."""
    from plgs.plgs_blender.results import read_result

    from tests.plgs_blender.tiny_lift import mend_manifest

    mend_manifest(folder / "lift")
    assert np.isfinite(read_result(folder / "lift").points.xyz).all()


READERS = {name: Reader(write, partial(look_into, name=name)) for name, write in WRITERS.items()}
READERS |= {
    "lift": Reader(write_lift, read_lift, "lift/**/*.json*", examples=80),
    "lists": Reader(write_lift, read_lift, "lift/cache/*", examples=10),
    "corrections": Reader(write_corrections, read_corrections, f"lift/{CORRECTIONS}", examples=80),
    "splats": Reader(write_splats, read_splats, examples=25),
    "images": Reader(write_images, read_images, examples=40),
    "passes": Reader(write_passes, lambda folder: read_exr(folder / "a.exr"), allowed=(ValueError,), examples=12),
    "notes": Reader(write_passes, lambda folder: read_note(folder / "a.exr", "n"), allowed=(ValueError,), examples=10),
}
if HAS_BLENDER:
    from plgs.engine.errors import PlgsError as BlenderError

    REFUSED: tuple[type[Exception], ...] = (PlgsError, BlenderError)
    READERS |= {
        "passes in Blender": Reader(write_blender_lift, read_blender_passes, "lift/result/passes/*", examples=25),
        "points in Blender": Reader(write_blender_lift, read_blender_lift, "lift/result/*.npz", examples=30),
    }
else:
    REFUSED = (PlgsError,)


def refused_by_a_line(look: Callable[[], object], allowed: tuple[type[Exception], ...] = ()) -> None:
    try:
        look()
    except REFUSED as error:
        assert not {"\n", "\x1b"} & set(str(error)) and error.fix.endswith((".", "?")), str(error)  # type: ignore[attr-defined]
    except allowed:
        pass


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[str], Path]]:
    """The folder of good files, which are written once."""
    written: dict[str, Path] = {}

    def of(name: str) -> Path:
        if name not in written:
            written[name] = tmp_path_factory.mktemp("good") / "good"
            written[name].mkdir()
            READERS[name].write(written[name])
        return written[name]

    yield of


@pytest.mark.hypothesis
@pytest.mark.parametrize("name", READERS)
def test_randomly_spoilt_files_are_read_or_give_a_one_line_error(good: Callable[[str], Path], name: str) -> None:
    reader, folder = READERS[name], good(name)
    files = sorted(path for path in folder.glob(reader.files) if path.is_file())
    by_suffix = {path.suffix: [one for one in files if one.suffix == path.suffix] for path in files}  # kinds of files

    @examples(reader.examples)
    @given(data=st.data())
    def spoil(data: st.DataObject) -> None:
        path = data.draw(st.sampled_from(by_suffix[data.draw(st.sampled_from(sorted(by_suffix)))]))
        how: Spoil = data.draw(st.sampled_from([damaged, odd_word, odd_value, odd_entry]))
        with with_content(path, how(data.draw, path.read_bytes())):
            refused_by_a_line(lambda: reader.read(folder), reader.allowed)

    spoil()


def test_every_scene_format_is_tested_with_spoilt_files(good: Callable[[str], Path]) -> None:
    samples = {name: good(name) / ("ai_001_001" if name == "hypersim" else "") for name in WRITERS}
    assert {find_format(place).name for place in samples.values()} == {each.name for each in FORMATS}
    masks = {name: found for name, place in samples.items() if (found := mask_place(place, None)) is not None}
    named = {name: OPTIONS.get(name, {}).get("mask_format") for name in masks}
    assert {find_mask_format(masks[name], named[name]).name for name in masks} == {each.name for each in MASK_FORMATS}


NUMBERS = ("1" + "0" * 400, "9" * 5000, "1e999", str(2**63), "-1")


@pytest.mark.parametrize("name", sorted(WRITERS))
def test_impossible_numbers_in_scene_files_are_refused(good: Callable[[str], Path], name: str) -> None:
    """Each number of each JSON, and each key that is one, once with each of these in its place."""
    folder = good(name)
    files = {path.parent: path for path in folder.rglob("*.json") if path.is_file()}  # one of a folder's
    for path in files.values():
        content = json.loads(path.read_bytes())
        kinds = {tuple("" if isinstance(key, int) else key for key in way): way for way in places(content)}
        for way, number in itertools.product(kinds.values(), NUMBERS):
            text = with_number(content, way, number)
            if text is not None:
                with with_content(path, text.encode()):
                    refused_by_a_line(lambda: READERS[name].read(folder))


def with_number(content: Any, way: tuple[Any, ...], number: str) -> str | None:
    """The document with another number there; None if there is none."""
    *outer, key = way or (None,)
    holder = content = copy.copy(content)
    for each in outer:
        holder[each] = holder = copy.copy(holder[each])
    if isinstance(key, str) and key.isdecimal():
        holder[number] = holder.pop(key)
    elif key is not None and type(holder[key]) in (int, float):
        holder[key] = "@"
    else:
        return None
    return json.dumps(content).replace('"@"', number)


HOLES: dict[str, Callable[[Any, Any], Any]] = {
    "none": lambda y, x: True,
    "rows": lambda y, x: y % 2 == 0,
    "columns": lambda y, x: x % 3 == 0,
    "grid": lambda y, x: (y % 2 == 0) & (x % 2 == 0),
    "chequers": lambda y, x: (y + x) % 2 == 0,
    "all but one": lambda y, x: (y == 5) & (x == 7),
    "border": lambda y, x: (y == 0) | (y == 23) | (x == 0),
    "half": lambda y, x: x < 16,
    "all": lambda y, x: False,
}
DEPTHS: dict[str, Callable[[Any, np.random.Generator], Any]] = {
    "as it is": lambda depth, random: depth,
    "flat": lambda depth, random: np.full_like(depth, 1500),
    "noise": lambda depth, random: random.integers(1, 65536, depth.shape),
    "steps": lambda depth, random: depth // 1000 * 1000,
    "far": lambda depth, random: np.full_like(depth, 65535),
    "near": lambda depth, random: np.ones_like(depth),
    "one spike": lambda depth, random: np.where(random.permutation(depth.size).reshape(depth.shape), depth, 65535),
}
POSES: dict[str, Callable[[Any, int], Any]] = {
    "as it is": lambda pose, number: pose,
    "all one": lambda pose, number: np.eye(4),
    "one far away": lambda pose, number: pose + (number == 2) * np.eye(4, k=3) * 9e3,
    "mirrored": lambda pose, number: pose * [-1, 1, 1, 1],
    "scaled": lambda pose, number: pose * [1, 1, 1, 1e3],
    "jumping": lambda pose, number: pose + (number % 2) * np.eye(4, k=3) * 5.0,
    "no number": lambda pose, number: pose if number != 1 else np.full((4, 4), -np.inf),
}
FOCAL = st.sampled_from([1e-3, 0.1, 1.0, 22.8, 300.0, 3e4, 1e9]) | st.floats(1e-6, 1e6)
CENTRE = st.sampled_from([-1e6, -10.0, 0.0, 16.0, 1e6]) | st.floats(-100.0, 100.0)
HOLE = st.sampled_from(sorted(HOLES))
SCENES: dict[str, st.SearchStrategy[Any]] = {
    "lens": st.none() | st.tuples(FOCAL, FOCAL, CENTRE, CENTRE),
    "holes": st.lists(HOLE, min_size=5, max_size=5) | HOLE.map(lambda one: [one] * 5),
    "depths": st.sampled_from(sorted(DEPTHS)),
    "poses": st.sampled_from(sorted(POSES)),
}


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny_scene(tmp_path_factory.mktemp("tiny") / "scene", frames=5, size=(32, 24))


def look_at(
    tiny: Path, scene: Path, *, lens: tuple[float, ...] | None, holes: list[str], depths: str, poses: str
) -> None:
    """Inspect and diagnose the scene with other cameras and depth."""
    shutil.rmtree(scene, ignore_errors=True)
    shutil.copytree(tiny, scene)
    random = np.random.default_rng(0)
    if lens is not None:
        fx, fy, cx, cy = lens
        np.savetxt(scene / "intrinsic" / "intrinsic_color.txt",
                   [[fx, 0, cx, 0], [0, fy, cy, 0], [0, 0, 1, 0], [0, 0, 0, 1]])  # fmt: skip
    for number, path in enumerate(sorted((scene / "depth").iterdir())):
        depth = DEPTHS[depths](cv2.imread(str(path), cv2.IMREAD_UNCHANGED), random)
        keep = HOLES[holes[number]](*np.indices(depth.shape))
        cv2.imwrite(str(path), np.where(keep, depth, 0).astype(np.uint16))
    for number, path in enumerate(sorted((scene / "pose").iterdir())):
        np.savetxt(path, POSES[poses](np.loadtxt(path), number))
    opened = open_scene(scene)
    survey_scene(opened)
    assert diagnose(opened).as_json()


@pytest.mark.hypothesis
@pytest.mark.parametrize("count", [4, pytest.param(300, marks=pytest.mark.slow)])
def test_diagnosis_copes_with_odd_cameras_and_depth(tiny: Path, tmp_path: Path, count: int) -> None:
    @examples(count)
    @given(drawn=st.fixed_dictionaries(SCENES))
    def look(drawn: dict[str, Any]) -> None:
        refused_by_a_line(lambda: look_at(tiny, tmp_path / "scene", **drawn))

    look()


@pytest.mark.parametrize("holes", ["rows", "columns", "grid", "chequers"])
def test_diagnosis_copes_with_depth_full_of_holes(tiny: Path, tmp_path: Path, holes: str) -> None:
    look_at(tiny, tmp_path / "scene", lens=None, holes=[holes] * 5, depths="as it is", poses="as it is")
