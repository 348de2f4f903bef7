"""Write a new scene folder with certain faults corrected. The user's files stay unchanged. The result is read again and
measured before it is used."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import PlgsError
from ..job import write_atomically
from ..job.own_files import PART, OwnFiles
from ..scene import Camera, ClassTable, Frame, Scene, evenly_spread, open_scene
from ..scene.depth import MILLIMETRES
from ..scene.pixels import image_bytes
from .findings import Diagnosis, Mending
from .reprojection import Assumption, assumed_poses, examine, lens_under, planar
from .trials import agreement, is_far_better

_DEEPEST = 65535  # maximum depth in this layout, in millimetres


def write_mended(scene: Scene, diagnosis: Diagnosis, out: Path) -> str | None:
    """Write the corrected scene to the folder ``out``, which must not exist, as a whole or not at all. The result is
    read again; if it is no improvement, it is deleted and the reason is returned, otherwise None. Colour images are
    hard links where they are files of their own, and PNGs otherwise. Depth is in millimetres, masks are COCO panoptic,
    and ground truth is images of classes and instances. Raises PlgsError for bad files."""
    if out.exists():
        raise PlgsError("exists", "the folder for the mended scene already exists", out, "Name a new one.")
    if out.resolve().is_relative_to(scene.folder.resolve()):
        what = "the mended scene would lie inside the scene itself"
        raise PlgsError("inside-scene", what, out, "Name a folder outside it.")
    frames = [frame for frame in scene.frames if frame.name not in diagnosis.mending.dropped]
    if not any(not frame.held_out for frame in frames):
        raise PlgsError("no-training-frame", "no frame to train on would be left", scene.folder, "Give more frames.")
    for number in count(1):
        part = out.with_name(f"{PART}{number}-{out.name}")  # beside it, as a rename to another disk fails
        OwnFiles(part).discard()  # what a killed run left, but nobody else's files
        if not part.exists():
            break
    own = OwnFiles(part).begin("mended scene", {"scene": str(scene.folder)})
    try:
        with own:
            _write(scene, frames, diagnosis, part)
        harm = harm_of(scene, diagnosis, part)
        if harm is not None:
            own.discard()
            return harm
        own.complete()
        part.rename(out)
        return None
    except OSError as error:
        own.discard()
        where = error.filename or out
        what = f"the mended scene cannot be written ({error.strerror})"
        raise PlgsError("unwritable", what, where, "Choose another folder.") from error
    except BaseException:  # Ctrl-C as well
        own.discard()
        raise


def _write(scene: Scene, frames: list[Frame], diagnosis: Diagnosis, folder: Path) -> None:
    mending, upright = diagnosis.mending, np.eye(4)
    if mending.turn is not None:
        upright[:3, :3] = mending.turn
    turn = np.eye(3) if scene.turn is None else scene.turn
    poses = assumed_poses(np.stack([frame.camera.camera_to_world for frame in frames]), turn, mending.assumed)
    for frame, pose in zip(frames, upright @ poses, strict=True):
        w, h = frame.camera.width, frame.camera.height
        fx, fy, cx, cy = _lens(frame.camera, mending.assumed)[0].tolist()
        camera = replace(frame.camera, fx=fx * w, fy=fy * h, cx=cx * w, cy=cy * h)
        source = frame.colour_path
        if frame.file_shows_colour and source.suffix.lower() in (".jpg", ".jpeg", ".png"):
            _link_or_copy(source.resolve(), folder / "color" / f"{frame.name}{source.suffix.lower()}")
        else:
            _write_image(folder / "color" / f"{frame.name}.png", frame.read_colour(None))
        _write_matrix(folder / "pose" / f"{frame.name}.txt", pose)
        matrix = np.eye(4)
        matrix[:3, :3] = camera.K
        matrix[:2, 2] -= 0.5  # in this layout the centres of pixels are whole numbers
        _write_matrix(folder / "intrinsic" / f"{frame.name}.txt", matrix)
        if frame.read_depth is not None:
            millimetres = np.round(_mended_depth(frame, mending) / MILLIMETRES)
            millimetres[millimetres > _DEEPEST] = 0  # none, rather than a wrong depth
            _write_image(folder / "depth" / f"{frame.name}.png", millimetres.astype(np.uint16))
        if frame.read_ground_truth is not None:
            truth = frame.read_ground_truth(None)
            _write_image(folder / "gt" / "semantic" / f"{frame.name}.png", truth.semantic.astype(np.uint16))
            _write_image(folder / "gt" / "instance" / f"{frame.name}.png", truth.instance.astype(np.uint16))
    if all(frame.read_mask is not None for frame in frames) and not _link_group_masks(scene, frames, folder):
        _write_masks(frames, scene.classes, folder)
    split = {"train": [f.name for f in frames if not f.held_out], "test": [f.name for f in frames if f.held_out]}
    write_atomically(folder / "splits.json", json.dumps(split))
    said = {
        "made_from": str(scene.folder.resolve()),
        "mended": [finding.as_json() for finding in diagnosis.findings if finding.is_mended],
        "left": [finding.as_json() for finding in diagnosis.findings if not finding.is_mended],
    }
    write_atomically(folder / "mended.json", json.dumps(said, indent=1))


def _lens(camera: Camera, assumed: Assumption) -> NDArray[np.float64]:
    """Return the corrected fx, fy, cx, cy as fractions of the picture: float64 [1, 4]."""
    w, h = camera.width, camera.height
    return lens_under(np.array([[camera.fx / w, camera.fy / h, camera.cx / w, camera.cy / h]]), assumed)


def _link_or_copy(source: Path, target: Path) -> None:
    """Make a hard link, so that the original may be deleted, or a copy if the file system has no links."""

    def put(part: Path) -> None:
        try:
            if not os.access(source, os.W_OK):
                raise PermissionError  # the link could not be flushed to the disk
            os.link(source, part)
        except OSError:
            shutil.copyfile(source, part)

    write_atomically(target, put)


def _mended_depth(frame: Frame, mending: Mending) -> NDArray[np.float64]:
    """Return the corrected planar depth in metres, float64 [H, W]."""
    depth = frame.depth(None).astype(np.float64)
    height, width = depth.shape
    x, y = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
    places = np.stack([x, y], -1).reshape(1, -1, 2)
    depth = planar(depth.reshape(1, -1), places, _lens(frame.camera, mending.assumed), mending.assumed)
    depth = depth.reshape(height, width)
    moved = np.zeros_like(depth)  # depth that would come from outside the picture is unknown
    right, down = round(mending.depth_shift[0] * width), round(mending.depth_shift[1] * height)
    moved[max(down, 0) : height + min(down, 0), max(right, 0) : width + min(right, 0)] = depth[
        max(-down, 0) : height - max(down, 0), max(-right, 0) : width - max(right, 0)
    ]
    return moved


def _link_group_masks(scene: Scene, frames: list[Frame], folder: Path) -> bool:
    """Link the scene's masks if segments may be several objects, which COCO panoptic lacks. Returns whether it did."""
    theirs = [path for path in scene.folder.glob("m2f_*") if path.is_dir()] if scene.folder.is_dir() else []
    if not theirs or not any(segment.is_group for frame in frames for segment in frame.mask(None).segments):
        return False
    for source in theirs:
        for path in source.iterdir():
            if path.is_file():
                _link_or_copy(path.resolve(), folder / source.name / path.name)
    return True


def _write_masks(frames: list[Frame], classes: ClassTable, folder: Path) -> None:
    annotations = []
    for frame in frames:
        mask = frame.mask(None)
        rgb = np.stack([mask.ids % 256, mask.ids // 256 % 256, mask.ids // 65536], -1).astype(np.uint8)
        _write_image(folder / "panoptic" / f"{frame.name}.png", rgb)
        segments = [
            {"id": each.id, "category_id": each.class_id, "score": each.score, "iscrowd": int(each.is_group)}
            for each in mask.segments
        ]
        annotations.append({"image_id": frame.name, "file_name": f"{frame.name}.png", "segments_info": segments})
    categories = [
        {"id": each.id, "name": each.name, "isthing": int(each.is_thing), "color": list(each.colour)}
        for each in classes.categories
    ]
    table = {"annotations": annotations, "categories": categories}
    write_atomically(folder / "panoptic.json", json.dumps(table))


def _write_image(path: Path, pixels: NDArray[np.integer[Any]]) -> None:
    write_atomically(path, image_bytes(pixels))


def _write_matrix(path: Path, matrix: NDArray[np.float64]) -> None:
    write_atomically(path, partial(np.savetxt, X=matrix, fmt="%.12g"))


_LOOKED_AT = 8  # frames whose depth is compared pixel by pixel
_KEPT = 0.9  # minimum fraction of the depth that a fixed scene keeps
_NEAREST, _FARTHEST = 0.1, 50.0  # bounds of the median depth in metres
_NO_WORSE = 0.98


def harm_of(scene: Scene, diagnosis: Diagnosis, folder: Path) -> str | None:
    """Return why the corrected scene in ``folder`` is no improvement on ``scene``, such as "most of the depth would be
    lost". None if it is better: it opens, keeps its depth, has the size of a room, and its views agree far better."""
    try:
        mended = open_scene(folder)
        examined = examine(mended)
        if diagnosis.agreement is None:  # nothing to compare with: too little depth
            return None
        before_of = {frame.name: frame for frame in scene.frames}
        chosen = evenly_spread([frame for frame in mended.frames if frame.read_depth is not None], _LOOKED_AT)
        had = sum(int((before_of[frame.name].depth(None) > 0.0).sum()) for frame in chosen)
        values = [depth[depth > 0.0] for depth in (frame.depth(None) for frame in chosen)]
    except PlgsError as error:
        return f"it could not be read again ({error.what})"
    has = sum(len(each) for each in values)
    kept, metres = has / max(had, 1), float(np.median(np.concatenate(values))) if has else 0.0
    if kept < _KEPT:
        return f"{1.0 - kept:.0%} of the depth would be lost"
    if not _NEAREST <= metres <= _FARTHEST:
        return f"the median depth would be {metres:.3g} m"
    if examined is None:
        return "fewer than three frames would have depth"
    before, after = diagnosis.agreement, agreement(examined.views, examined.pairs, Assumption())
    has_new_numbers = diagnosis.mending.assumed != Assumption() or diagnosis.mending.depth_shift != (0.0, 0.0)
    is_good = is_far_better(after, before) if has_new_numbers else after.mean >= _NO_WORSE * before.mean
    if not is_good:
        return f"its views would agree on {after.share:.0%} of what two see, against {before.share:.0%} as it is"
    return None
