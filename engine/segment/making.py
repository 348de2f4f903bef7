"""Masks of all frames of a scene as COCO panoptic, frame by frame. Frames with a mask are not made again.

``panoptic/<frame>.png`` and ``.json`` are written one by one; ``panoptic/made_by.json`` names the model.
``panoptic.json`` is written last, and without it there are no masks yet.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..errors import PlgsError
from ..job import write_atomically
from ..json_file import read_object, read_value
from ..scene import ClassLabel, Frame, Scene, digests_of_files
from .merging import MadeSegment

TABLE, FOLDER, MADE_BY = "panoptic.json", "panoptic", "made_by.json"
_OTHER_MASKS = ("m2f_semantics", "m2f_notta_semantics", "masks")
Progress = Callable[[int, int, int], object]
"""Called after each frame with the numbers done, of all, and made in this run. Its errors end the work."""


class Segmenter(Protocol):
    """A network: its ``name``, its classes, and the mask of a picture (see ``merge_queries``)."""

    @property
    def name(self) -> str: ...

    @property
    def labels(self) -> tuple[ClassLabel, ...]: ...

    def segment(self, colour: NDArray[np.uint8]) -> tuple[NDArray[np.int32], list[MadeSegment]]: ...


@dataclass(frozen=True)
class Job:
    """The folder of the masks, whether an earlier run began with them, and whether they are complete."""

    folder: Path
    is_begun: bool
    is_finished: bool

    @property
    def pictures(self) -> Path:
        return self.folder / FOLDER

    def discard_if_empty(self) -> None:
        """Remove the files of ``begin_job`` if there is no mask yet."""
        if not self.is_begun:
            (self.pictures / MADE_BY).unlink(missing_ok=True)
            self.pictures.rmdir()


def begin_job(folder: Path, model: str, frames: Sequence[Frame]) -> Job:
    """Begin in ``folder``, or continue there. Raises PlgsError for masks of other programs, another model or other
    photos: nothing is overwritten."""
    made_by, of_files = folder / FOLDER / MADE_BY, digests_of_files([(frame.colour_path,) for frame in frames])
    named = [*zip((frame.name for frame in frames), of_files, strict=True)]
    photos = sha256(repr(named).encode()).hexdigest() if all(of_files) else ""  # not known
    fix = "Name another folder with -o, or remove these."
    if made_by.is_file():
        content = read_object(made_by, fix)
        if content.get("model") != model or content.get("frames") != len(frames):
            raise PlgsError(f"masks by {content.get('model')} of {content.get('frames')} frames are here", folder, fix)
        if photos and content.get("photos", "") not in ("", photos):
            raise PlgsError("the photos have changed since masks of them were made here", folder, fix)
        return Job(folder, True, (folder / TABLE).is_file())
    others = [name for name in (TABLE, FOLDER, *_OTHER_MASKS) if (folder / name).exists()]
    if others:
        raise PlgsError(f"there are masks already ({others[0]})", folder, fix)
    try:
        write_atomically(made_by, json.dumps({"model": model, "frames": len(frames), "photos": photos}) + "\n")
    except OSError as error:
        raise PlgsError(f"this cannot be written ({error.strerror})", folder, "Name another with -o.") from error
    return Job(folder, False, False)


def make_masks(scene: Scene, job: Job, network: Segmenter, progress: Progress) -> None:
    """Make the masks that are missing, then the table. Raises PlgsError, OSError."""
    made = 0
    for done, frame in enumerate(scene.frames, start=1):
        segments, picture = (job.pictures / f"{frame.name}{suffix}" for suffix in (".json", ".png"))
        if not (segments.is_file() and picture.is_file()):
            ids, found = network.segment(frame.read_colour(None))
            write_atomically(picture, _png(ids))
            write_atomically(segments, json.dumps(_segments(ids, found)))
            made += 1
        progress(done, len(scene.frames), made)
    names = [frame.name for frame in scene.frames]
    annotations = [
        {"image_id": name, "file_name": f"{name}.png", "segments_info": read_list(job.pictures / f"{name}.json")}
        for name in names
    ]
    content = {"annotations": annotations, "categories": [_category(label) for label in network.labels]}
    write_atomically(job.folder / TABLE, json.dumps(content, ensure_ascii=False) + "\n")
    for name in names:
        (job.pictures / f"{name}.json").unlink()


def read_list(path: Path) -> list[object]:
    """The segments of a frame that was made before. Raises PlgsError when the file is damaged."""
    fix = "Delete this file, then start again."
    content = read_value(path, fix)
    if not isinstance(content, list):
        raise PlgsError("this frame's segments are not a list", path, fix)
    return list(content)


def _segments(ids: NDArray[np.int32], found: list[MadeSegment]) -> list[dict[str, object]]:
    return [
        {
            "id": one.id,
            "category_id": one.label + 1,
            "score": round(one.score, 4),
            "area": int((ids == one.id).sum()),
            "iscrowd": 0,
        }
        for one in found
    ]


def _category(label: ClassLabel) -> dict[str, object]:
    """Category ids count from 1, as 0 is void."""
    return {"id": label.id + 1, "name": label.name, "isthing": int(label.is_thing)}


def _png(ids: NDArray[np.int32]) -> bytes:
    """Ids int32 [H, W] as R + 256 G + 65536 B."""
    import cv2

    colours = np.stack([ids >> 16 & 255, ids >> 8 & 255, ids & 255], axis=-1).astype(np.uint8)  # OpenCV's B, G, R
    done, data = cv2.imencode(".png", colours)
    if not done:
        raise ValueError(f"cannot encode ids of shape {ids.shape} as PNG")
    return data.tobytes()
