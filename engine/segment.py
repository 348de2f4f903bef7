"""Make masks with a network (`engine/mask_networks.py`) for scenes without any: COCO panoptic, frame by frame. Existing
masks are kept. ``panoptic/<frame>.png`` and ``.json`` are written one by one; ``panoptic/made_by.json`` names the
model. ``detections.json`` has every query that could be something, for ``lift --detections``: masks omit most of these.
``panoptic.json`` is written last; until then, the scene counts as having no masks."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Sequence, Set
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from .errors import PlgsError
from .job import write_atomically
from .job.own_files import OwnFiles
from .json_file import read_object, take_objects
from .known_networks import licence_of
from .scene import ClassLabel, Frame, Scene, digests_of_files
from .scene.made import read_note
from .scene.pixels import write_image

Rounds = tuple[float, ...]
"""The minimum scores of queries to become segments: those of a later round take what the earlier ones left."""
MERGES: dict[str, Rounds] = {"one": (0.5,), "two": (0.5, 0.25)}
"""The rounds by the names of ``segment --merge``; two as in the second version of PanSt3R (naver/panst3r)."""
INSIDE = 0.5
"""Minimum probability of a pixel in a query's mask."""
LEAST_DETECTION = 0.1
"""Minimum score of a query that is kept beside the panoptic masks."""
VISIBLE = 0.8
"""Minimum share of a segment that others leave visible; otherwise it is dropped."""


@dataclass(frozen=True)
class MadeSegment:
    """A segment of a mask that a network made: its ``id`` in the mask, the network's ``label``, its score in [0, 1]."""

    id: int
    label: int
    score: float

    def to_json(self) -> dict[str, object]:
        """Return the segment's entry in COCO's segments_info, for a table whose class ids count from 1."""
        return {"id": self.id, "category_id": self.label + 1, "score": round(self.score, 4), "iscrowd": 0}


def merge_queries(
    class_logits: torch.Tensor, mask_probabilities: torch.Tensor, stuff: Set[int], rounds: Rounds = (0.5,)
) -> tuple[NDArray[np.int32], list[MadeSegment]]:
    """Merge a network's queries into a mask. Returns segment ids, int32 [H, W] with 0 = none, and the segments.
    ``class_logits`` is float [Q, C + 1], with "no object" as the last class, ``mask_probabilities`` float [Q, H, W]. A
    pixel goes to the query with the greatest score times probability. ``stuff`` are labels with one segment per
    picture, whose score is the mean of its queries' scores, weighted by pixels. ``rounds`` are minimum scores: a later
    round fills what earlier ones left."""
    ids = np.zeros(mask_probabilities.shape[1:], np.int32)
    scores, labels = class_logits.softmax(-1).max(-1)
    found: dict[int, list[tuple[float, int]]] = {}
    label_of: dict[int, int] = {}
    stuff_id: dict[int, int] = {}
    for least, most in zip(rounds, (2.0, *rounds), strict=False):
        kept = (labels < class_logits.shape[-1] - 1) & (scores > least) & (scores <= most)
        if not bool(kept.any()):
            continue
        masks, free = mask_probabilities[kept], ids == 0
        owner = (masks * scores[kept, None, None]).argmax(0)
        for query, (label, score) in enumerate(zip(labels[kept].tolist(), scores[kept].tolist(), strict=True)):
            inside = masks[query] >= INSIDE
            region = (inside & (owner == query)).numpy() & free
            pixels = int(region.sum())
            if pixels == 0 or pixels < VISIBLE * int(inside.sum()):
                continue
            number = len(found) + 1
            if label in stuff:
                number = stuff_id.setdefault(label, number)
            label_of[number] = label
            found.setdefault(number, []).append((score, pixels))
            ids[region] = number
    weighted = {n: sum(score * pixels for score, pixels in parts) for n, parts in found.items()}
    means = {n: weighted[n] / sum(pixels for _, pixels in parts) for n, parts in found.items()}
    return ids, [MadeSegment(number, label_of[number], score) for number, score in means.items()]


@dataclass(frozen=True)
class Detection:
    """A network's query before merging: its ``label``, its score in [0, 1], and its ``pixels``, bool [H, W]."""

    label: int
    score: float
    pixels: NDArray[np.bool_]

    def to_json(self) -> dict[str, object]:
        """Return its class, score and run lengths as COCO has them, for a table whose class ids count from 1."""
        from pycocotools import mask as rle_tools

        runs = rle_tools.encode(np.asfortranarray(self.pixels, np.uint8))  # pycocotools takes column-major arrays only
        counts = {"size": runs["size"], "counts": runs["counts"].decode("ascii")}
        return {"category_id": self.label + 1, "score": round(self.score, 4), "segmentation": counts}


def detections_of(class_logits: torch.Tensor, mask_probabilities: torch.Tensor) -> list[Detection]:
    """Return the queries whose most probable class reaches LEAST_DETECTION, from class logits, float [Q, C + 1] with
    "no object" last, and mask probabilities, float [Q, H, W]."""
    scores, labels = class_logits.softmax(-1)[:, :-1].max(-1)  # the best class even if "no object" is likelier
    inside = (mask_probabilities >= INSIDE).numpy()
    return [
        Detection(label, score, pixels)
        for label, score, pixels in zip(labels.tolist(), scores.tolist(), inside, strict=True)
        if score >= LEAST_DETECTION and pixels.any()
    ]


TABLE, FOLDER, MADE_BY, DETECTIONS = "panoptic.json", "panoptic", "made_by.json", "detections.json"
LEFT_OUT = "left_out"
"""The key in the table of a frame that was given an empty mask, as it was not wanted."""
_OTHERS_FIX = "Remove these masks, or write into another folder."
_OTHER_MASKS = ("m2f_semantics", "m2f_notta_semantics", "masks")
Progress = Callable[[int, int, int], object]
"""Called after each frame with the number done, the total, and the number made in this run. Its errors end the work."""


class Segmenter(Protocol):
    """A segmentation network: its ``name``, its classes, and a method that segments a picture."""

    @property
    def name(self) -> str: ...

    @property
    def labels(self) -> tuple[ClassLabel, ...]: ...

    def segment(self, colour: NDArray[np.uint8]) -> tuple[NDArray[np.int32], list[MadeSegment], list[Detection]]: ...


@dataclass(frozen=True)
class Job:
    """The making of masks in a ``folder``. ``own`` records which files there are ours. ``is_begun``: an earlier run
    began it; ``is_finished``: all masks that are wanted exist."""

    folder: Path
    own: OwnFiles
    is_begun: bool
    is_finished: bool

    @property
    def pictures(self) -> Path:
        return self.folder / FOLDER

    def discard_if_empty(self) -> None:
        """Remove the files that ``begin_job`` wrote if there is no mask yet."""
        if not self.is_begun:
            self.own.discard()


def masks_in(folder: Path) -> list[str]:
    """Return the names of the files and folders with masks, of any origin, in a scene's ``folder``."""
    return [name for name in (TABLE, FOLDER, DETECTIONS, *_OTHER_MASKS) if (folder / name).exists()]


def refuse_others(folder: Path) -> None:
    """Raise PlgsError if a scene's ``folder`` has masks that `begin_job` did not begin."""
    if (others := masks_in(folder)) and not (folder / FOLDER / MADE_BY).exists():
        raise PlgsError("has-masks", f"there are masks already ({others[0]})", folder, _OTHERS_FIX)


def begin_job(folder: Path, model: str, frames: Sequence[Frame], wanted: Collection[str] | None = None) -> Job:
    """Begin masks of the frames ``wanted`` (None: all) in ``folder``, or continue there. Raises PlgsError, and
    overwrites nothing, for masks of other programs, another ``model`` or other photos."""
    refuse_others(folder)
    made_by, of_files = folder / FOLDER / MADE_BY, digests_of_files([(frame.colour_path,) for frame in frames])
    named = [*zip((frame.name for frame in frames), of_files, strict=True)]
    photos = sha256(repr(named).encode()).hexdigest() if all(of_files) else ""  # not known
    own = OwnFiles(folder)
    if (content := read_note(made_by, _OTHERS_FIX)) is not None:
        if content.get("model") != model or content.get("frames") != len(frames):
            what = f"there are already masks of {content.get('frames')} frames by {content.get('model')}"
            raise PlgsError("other-masks", what, folder, _OTHERS_FIX)
        if photos and content.get("photos", "") not in ("", photos):
            what = "the photos have changed since masks of them were made here"
            raise PlgsError("photos-changed", what, folder, _OTHERS_FIX)
        left_out = _left_out(folder / TABLE)
        is_finished = left_out is not None and not (left_out if wanted is None else left_out.intersection(wanted))
        if not is_finished:  # which needs no folder that can be written to
            own.begin("masks", {"model": model}, among_others=True)
        return Job(folder, own, True, is_finished)
    try:
        record = {"model": model, "frames": len(frames), "photos": photos, **licence_of(model)}
        with own.begin("masks", {"model": model}, among_others=True):
            write_atomically(made_by, json.dumps(record) + "\n")
    except OSError as error:
        what = f"the masks cannot be written ({error.strerror})"
        raise PlgsError("unwritable", what, folder, "Name another folder with -o.") from error
    return Job(folder, own, False, False)


def _left_out(table: Path) -> set[str] | None:
    """Return the frames to which a finished run gave empty masks; None without its table."""
    content = read_note(table, "Delete this file, then start again.")
    if content is None:
        return None
    entries = take_objects(content, "annotations", "the file", table)
    return {str(entry.get("image_id")) for entry in entries if entry.get(LEFT_OUT)}


def make_masks(
    scene: Scene, job: Job, network: Segmenter, progress: Progress, wanted: Collection[str] | None = None
) -> None:
    """Make the missing masks of the frames ``wanted`` (None: all), then the table, in which all other frames have empty
    masks. ``progress`` is called with (done, total, made in this run). Raises PlgsError for a bad file, OSError."""
    job.own.remove(job.folder / TABLE)  # an earlier run's table, in which these frames may have empty masks
    with job.own:
        left_out = _make_masks(scene, job, network, progress, wanted)
    for frame in () if left_out else scene.frames:  # a run that makes masks of more frames needs them
        job.own.remove(job.pictures / f"{frame.name}.json")  # last, as a run that was killed before needs them
    job.own.complete()


def _make_masks(
    scene: Scene, job: Job, network: Segmenter, progress: Progress, wanted: Collection[str] | None
) -> set[str]:
    """Make the missing masks and write the tables. Returns the names of the frames that have empty masks."""
    made, frames = 0, [frame for frame in scene.frames if wanted is None or frame.name in wanted]
    for done, frame in enumerate(frames, start=1):
        segments, picture = (job.pictures / f"{frame.name}{suffix}" for suffix in (".json", ".png"))
        if not (job.own.owns(segments) and job.own.owns(picture)):
            ids, found, detections = network.segment(frame.read_colour(None))
            # R + 256 G + 65536 B
            write_image(picture, np.stack([ids & 255, ids >> 8 & 255, ids >> 16 & 255], axis=-1).astype(np.uint8))
            seen = {"width": ids.shape[1], "height": ids.shape[0], "detections": [one.to_json() for one in detections]}
            listed = [one.to_json() | {"area": int((ids == one.id).sum())} for one in found]
            write_atomically(segments, json.dumps({"segments_info": listed, **seen}))
            made += 1
        progress(done, len(frames), made)
    left_out = {frame.name for frame in scene.frames if not job.own.owns(job.pictures / f"{frame.name}.json")}
    masks, images, annotations = list[object](), list[object](), list[object]()
    for number, frame in enumerate(scene.frames, start=1):
        name = frame.name
        if name in left_out:
            width, height = frame.size
            write_image(job.pictures / f"{name}.png", np.zeros((height, width, 3), np.uint8))
            masks.append({"image_id": name, "file_name": f"{name}.png", "segments_info": [], LEFT_OUT: True})
            images.append({"id": number, "file_name": f"{name}.png", "width": width, "height": height})
            continue
        content: Any = read_object(job.pictures / f"{name}.json", "Delete this file, then start again.")
        masks.append({"image_id": name, "file_name": f"{name}.png", "segments_info": content["segments_info"]})
        size = {"width": content["width"], "height": content["height"]}
        images.append({"id": number, "file_name": f"{name}.png", **size})
        first = len(annotations) + 1
        annotations += [{"id": first + k, "image_id": number, **one} for k, one in enumerate(content["detections"])]
    categories = [  # ids count from 1, as 0 is void
        {"id": label.id + 1, "name": label.name, "isthing": int(label.is_thing)} for label in network.labels
    ]
    over = {"images": images, "annotations": annotations, "categories": categories}
    for file, table in ((DETECTIONS, over), (TABLE, {"annotations": masks, "categories": categories})):
        write_atomically(job.folder / file, json.dumps(table, ensure_ascii=False) + "\n")  # TABLE last: all is done
    return left_out
