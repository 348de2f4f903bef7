"""What is found before the first step, kept beside the checkpoints: a resumed lift does not find it again."""

from __future__ import annotations

import hashlib
import logging
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import PlgsError
from ..instances.oriented_box import OrientedBox
from ..instances.records import ObjectMask, SceneObject
from ..job import Checkpoint, CheckpointStore, LiftFolder
from ..json_file import to_text
from ..metrics.unshown import Refused
from ..model.structured import StructuredScene, to_tensors
from ..records import record_of, to_json
from ..scene import View, stored
from ..scene_of_lift import masks_last_run
from ..semantics.point_cloud import SemanticPointCloud
from .objects import Matching
from .targets_of_views import Photos

log = logging.getLogger("plgs.lift")
_ARRAYS = "arrays.npz"
_LABELS = "labels "
_CLOUD = ("xyz", "rgb", "class_id", "confidence", "votes")


@dataclass(frozen=True)
class _KeptObject:
    """A `SceneObject`, whose points are the next ``points`` of all objects' points."""

    id: int
    class_id: int
    points: int
    centre: tuple[float, float, float]
    size: tuple[float, float, float]
    yaw: float
    masks: tuple[ObjectMask, ...]


@dataclass(frozen=True)
class _Kept:
    """What is not an array. Other code, other ``masks`` or other views (all digests) would find something else."""

    code: str
    masks: str
    views: str
    class_ids: tuple[int, ...]
    spacing: float
    dropped: int
    objects: tuple[_KeptObject, ...]
    refused: tuple[Refused, ...] = ()


@dataclass(frozen=True)
class KeptPreparation:
    """The matching and the photos' weights of a lift in its ``folder``. ``is_valid``: the lift is resumed, with the
    masks that it was begun with. ``checkpoint``: where it is resumed. ``code``: the digest of the code at work."""

    folder: LiftFolder
    is_valid: bool
    checkpoint: Checkpoint | None
    code: str

    @property
    def _store(self) -> CheckpointStore:
        return CheckpointStore(self.folder.path, "preparation")

    def write(self, views: Sequence[View], voters: int, matching: Matching, photos: Photos) -> None:
        """Keep what was found for these views and so many others. Raises OSError if the disk is full."""
        cloud, objects = matching.cloud, tuple(map(_kept, matching.instances))
        found_for = self.code, masks_last_run(self.folder), _digest(views, voters)
        about = _Kept(*found_for, cloud.class_ids, cloud.spacing, matching.dropped, objects, matching.refused)
        self._store.save(to_json(about), lambda folder: _write(folder / _ARRAYS, _arrays_of(matching, photos)))

    def read(self, views: Sequence[View], voters: int) -> tuple[Matching, Photos] | None:
        """What was found for these views and so many others, bit for bit; None if it has to be found again. Raises
        OSError if the disk is full."""
        try:
            there = self._store.latest() if self.is_valid else None
            if there is None:
                return None
            about = record_of(_Kept, there.state, there.path, "")
            wanted = self.code, masks_last_run(self.folder), _digest(views, voters)
            if (about.code, about.masks, about.views) != wanted:
                return None
            with np.load(there.path / _ARRAYS, allow_pickle=False) as arrays:
                return _matching(about, arrays, self.folder.path), _photos(arrays)
        except (PlgsError, KeyError, ValueError, zipfile.BadZipFile) as error:
            log.warning("what was found before the first step is found again: %s", error)
            return None

    def replaces(self, scene: StructuredScene) -> bool:
        """Whether the checkpoint will replace all that is learnt of a scene."""
        model = None if self.checkpoint is None or not self.is_valid else self.checkpoint.state.get("model")
        return isinstance(model, dict) and to_text(model) == to_text(to_tensors(scene)[1])


def refused_in(lift: LiftFolder) -> tuple[Refused, ...]:
    """The trials that a lift refused before its first step; none if what it found is not kept any more."""
    try:
        there = CheckpointStore(lift.path, "preparation").latest()
        return () if there is None else record_of(_Kept, there.state, there.path, "").refused
    except PlgsError as error:
        log.warning("what was tried and refused is not told: %s", error)
        return ()


def _digest(views: Sequence[View], voters: int) -> str:
    """Of all that the views show but their masks, and of the number of the other views that vote."""
    digest = hashlib.sha256(str(voters).encode())
    for view in views:
        digest.update(f"{view.name}\0{view.camera.size}".encode())
        for part in (view.camera.K, view.camera.camera_to_world, view.colour, view.depth):
            digest.update(np.ascontiguousarray(part).data)
    return digest.hexdigest()


def _kept(one: SceneObject) -> _KeptObject:
    x, y, z = one.box.centre.tolist()
    length, width, height = one.box.size.tolist()
    return _KeptObject(
        one.id, one.class_id, len(one.points), (x, y, z), (length, width, height), one.box.yaw, one.masks
    )


def _arrays_of(matching: Matching, photos: Photos) -> Iterator[tuple[str, NDArray[Any]]]:
    for name in _CLOUD:
        yield name, getattr(matching.cloud, name)
    yield "instance_of_point", matching.instance_of_point
    yield "points", np.concatenate([np.zeros((0, 3)), *(one.points for one in matching.instances)])
    yield from ((each.name, value) for each in fields(photos) if (value := getattr(photos, each.name)) is not None)
    for number, labels in enumerate(matching.label_maps or ()):
        yield f"{_LABELS}{number}", labels


def _write(path: Path, arrays: Iterator[tuple[str, NDArray[Any]]]) -> None:
    """Like `numpy.savez_compressed`, with one array in memory at a time."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, array in arrays:
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                np.lib.format.write_array(file, np.ascontiguousarray(array), allow_pickle=False)


def _matching(about: _Kept, arrays: Any, scratch: Path) -> Matching:
    cloud = SemanticPointCloud(
        **{name: arrays[name] for name in _CLOUD}, class_ids=about.class_ids, spacing=about.spacing
    )
    parts = np.split(arrays["points"], np.cumsum([one.points for one in about.objects])[:-1])
    instances = [
        SceneObject(
            one.id, one.masks, one.class_id, points, OrientedBox(np.array(one.centre), np.array(one.size), one.yaw)
        )
        for one, points in zip(about.objects, parts, strict=False)
    ]
    maps = [name for name in (f"{_LABELS}{number}" for number in range(len(arrays.files))) if name in arrays]
    labels = stored((arrays[name] for name in maps), scratch) if maps else None
    return Matching(cloud, instances, arrays["instance_of_point"], about.dropped, labels, refused=about.refused)


def _photos(arrays: Any) -> Photos:
    return Photos(arrays["weights"], arrays["gains"] if "gains" in arrays else None)
