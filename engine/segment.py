"""Makes masks with transformers' Mask2Former for scenes without any: COCO panoptic, frame by frame. Existing masks are
kept.

``panoptic/<frame>.png`` and ``.json`` are written one by one; ``panoptic/made_by.json`` names the model.
``detections.json`` has every query that could be something, for ``lift --detections``: masks omit most of these.
``panoptic.json`` is written last; until then, the scene counts as having no masks. The network comes from a folder or,
with the user's consent, from Hugging Face's hub. Only safetensors are read: no pickles, and no code that comes with a
model. transformers is imported late. Its own post-processing is not used: it works at 384x384 for any aspect ratio, and
its stuff fusion gives one id to several segments.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Mapping, Sequence, Set
from contextlib import suppress
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from .errors import PlgsError, lacks_part
from .job import write_atomically
from .job.atomic import sha256 as digest_of
from .job.own_files import OwnFiles
from .json_file import read_object
from .scene import ClassLabel, Frame, Scene, digests_of_files, labels_of_config, size_within
from .scene.pixels import write_image

PINNED = {"facebook/mask2former-swin-small-coco-panoptic": "823b60a9dddf1829580505654f6a00b306a65381"}
"""The revision that is loaded of a model without an own @REVISION: a commit of its repository on the hub, whose hash
covers the SHA-256 of the weights."""
LEAST_SCORE = 0.5
"""Minimum score of a query to become a segment."""
INSIDE = 0.5
"""Minimum probability of a pixel in a query's mask."""
LEAST_DETECTION = 0.1
"""Minimum score of a query that is kept beside the panoptic masks."""
VISIBLE = 0.8
"""Minimum share of a segment that others leave visible; otherwise it is dropped."""


@dataclass(frozen=True)
class MadeSegment:
    """Its value ``id`` in the mask, the network's ``label``, and its score in [0, 1]."""

    id: int
    label: int
    score: float

    def to_json(self) -> dict[str, object]:
        """Its entry in segments_info, for a table whose class ids count from 1."""
        return {"id": self.id, "category_id": self.label + 1, "score": round(self.score, 4), "iscrowd": 0}


def merge_queries(
    class_logits: torch.Tensor, mask_probabilities: torch.Tensor, stuff: Set[int]
) -> tuple[NDArray[np.int32], list[MadeSegment]]:
    """Segment ids, int32 [H, W] with 0 = none, and the segments. ``class_logits`` is float [Q, C + 1], with no object
    as the last class, ``mask_probabilities`` float [Q, H, W]. A pixel goes to the query with the greatest score times
    probability. ``stuff`` are labels with one segment per picture; its score is the mean of its queries', weighted by
    pixels."""
    ids = np.zeros(mask_probabilities.shape[1:], np.int32)
    scores, labels = class_logits.softmax(-1).max(-1)
    kept = (labels < class_logits.shape[-1] - 1) & (scores > LEAST_SCORE)
    if not bool(kept.any()):
        return ids, []
    masks = mask_probabilities[kept]
    owner = (masks * scores[kept, None, None]).argmax(0)
    found: dict[int, list[tuple[float, int]]] = {}
    label_of: dict[int, int] = {}
    stuff_id: dict[int, int] = {}
    for query, (label, score) in enumerate(zip(labels[kept].tolist(), scores[kept].tolist(), strict=True)):
        inside = masks[query] >= INSIDE
        region = (inside & (owner == query)).numpy()
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
    """A query before the merge: the network's ``label``, its score in [0, 1], and its ``pixels``, bool [H, W]."""

    label: int
    score: float
    pixels: NDArray[np.bool_]

    def to_json(self) -> dict[str, object]:
        """Its class, score and run lengths as COCO has them, for a table whose class ids count from 1."""
        from pycocotools import mask as rle_tools

        runs = rle_tools.encode(np.asfortranarray(self.pixels, np.uint8))  # pycocotools takes column-major arrays only
        counts = {"size": runs["size"], "counts": runs["counts"].decode("ascii")}
        return {"category_id": self.label + 1, "score": round(self.score, 4), "segmentation": counts}


def detections_of(class_logits: torch.Tensor, mask_probabilities: torch.Tensor) -> list[Detection]:
    """The queries whose likeliest class has LEAST_DETECTION or more, with the arguments of ``merge_queries``."""
    scores, labels = class_logits.softmax(-1)[:, :-1].max(-1)  # the best class even if "no object" is likelier
    inside = (mask_probabilities >= INSIDE).numpy()
    return [
        Detection(label, score, pixels)
        for label, score, pixels in zip(labels.tolist(), scores.tolist(), inside, strict=True)
        if score >= LEAST_DETECTION and pixels.any()
    ]


_LARGEST_SIDE = 1280
"""Maximum pixels of a mask's longer side; networks work at a lower resolution anyway."""


@dataclass(frozen=True)
class Mask2Former:
    """A loaded network: its ``name`` on loading, and its classes as ``labels``."""

    name: str
    labels: tuple[ClassLabel, ...]
    network: Any
    processor: Any

    @torch.inference_mode()
    def segment(self, colour: NDArray[np.uint8]) -> tuple[NDArray[np.int32], list[MadeSegment], list[Detection]]:
        """The mask of a picture uint8 [H, W, 3] RGB (``merge_queries``), and what it left out (``detections_of``)."""
        height, width = colour.shape[:2]
        inputs = self.processor(images=colour, return_tensors="pt", input_data_format="channels_last")
        seen = self.network(pixel_values=inputs["pixel_values"])
        masks = _resized(seen.masks_queries_logits, inputs["pixel_values"].shape[-2:])
        valid = inputs["pixel_mask"][0]  # the rest is padding
        masks = masks[..., : int(valid[:, 0].sum()), : int(valid[0].sum())]
        width, height = size_within((width, height), (_LARGEST_SIDE, _LARGEST_SIDE))
        stuff = frozenset(label.id for label in self.labels if not label.is_thing)
        classes, inside = seen.class_queries_logits[0], _resized(masks, (height, width))[0].sigmoid()
        return *merge_queries(classes, inside, stuff), detections_of(classes, inside)


def _resized(masks: torch.Tensor, size: tuple[int, ...]) -> torch.Tensor:
    return torch.nn.functional.interpolate(masks, size=tuple(size), mode="bilinear", align_corners=False)


def load_model(name: str, *, download: bool) -> Mask2Former:
    """Load the network in the folder ``name``, or the one of this name on the hub. Raises PlgsError. It is fetched only
    with ``download``; otherwise it must be on this computer already."""
    if not Path(name).is_dir() and (name.count("/") != 1 or name.startswith((".", "/", "~"))):
        fix = "Name a folder, or a model as OWNER/NAME or OWNER/NAME@REVISION."
        raise PlgsError("no-model", "there is no such folder or model", name, fix)
    if not download:  # the library reads this when it is imported
        os.environ["HF_HUB_OFFLINE"] = "1"
    try:
        from huggingface_hub import HfApi, constants, snapshot_download
        from safetensors import SafetensorError
        from transformers import Mask2FormerForUniversalSegmentation, Mask2FormerImageProcessorPil
        from transformers.utils import logging
    except ImportError as error:
        raise lacks_part(f"masks are made with the package transformers ({error})", name, "segment") from error
    logging.set_verbosity_error()
    logging.disable_progress_bar()
    folder, (model, _, revision) = Path(name), name.partition("@")
    limits: dict[str, Any] = {"local_files_only": True, "trust_remote_code": False}
    try:
        if not folder.is_dir():
            pin = Path(constants.HF_HUB_CACHE) / f"models--{model.replace('/', '--')}" / "plgs.json"
            pins: dict[str, Any] = read_object(pin, "Delete it.") if pin.is_file() else {}
            # What a name stands for may change on the hub: the revision that was downloaded first stays.
            pinned = revision or PINNED.get(model) or next(iter(pins), None)
            wanted = {"revision": pinned, "allow_patterns": ["*.json", "*.safetensors"]}
            if download:
                _ask_hub(HfApi(), model, pinned)
            folder = Path(snapshot_download(model, local_files_only=not download, **wanted))
            _check_pin(pin, pins, folder)
        labels = _checked_labels(folder, name)
        processor = Mask2FormerImageProcessorPil.from_pretrained(folder, **limits)
        network, loading = Mask2FormerForUniversalSegmentation.from_pretrained(
            folder, use_safetensors=True, output_loading_info=True, **limits
        )
    except (OSError, ValueError, KeyError, RuntimeError, TypeError, AttributeError, SafetensorError) as error:
        raise _not_loaded(name, download, error) from error
    wrong = {key.partition("_")[0]: keys for key, keys in loading.items() if keys}
    wrong["infinite"] = [key for key, one in network.state_dict().items() if not bool(torch.isfinite(one).all())]
    for kind, keys in wrong.items():
        if keys:
            what = f"{len(keys)} weights of the model are {kind}, such as {min(map(str, keys))}"
            raise PlgsError("model-broken", what, name, _ANOTHER)
    return Mask2Former(name, labels, network.eval(), processor)


_HUB_S = 15.0
"""Seconds within which huggingface.co must answer."""
_ANOTHER = "Name another one, or fetch it again."


def _checked_labels(folder: Path, name: str) -> tuple[ClassLabel, ...]:
    """The classes of the model, whose weights must be safetensors in its folder, unchanged since their download."""
    config, index = folder / "config.json", folder / "model.safetensors.index.json"
    if not config.is_file() or not any(folder.glob("*.safetensors")):
        fix = "Name a folder that transformers' save_pretrained wrote, with config.json and safetensors."
        raise PlgsError("no-model", "there is no model in this folder", folder, fix)
    parts = read_object(index, _ANOTHER).get("weight_map") if index.exists() else {}
    files = [*parts.values()] if isinstance(parts, dict) else [parts]
    for file in (*files, read_object(config, _ANOTHER).get("transformers_weights") or "model.safetensors"):
        if not isinstance(file, str) or not re.fullmatch(r"[\w.-]+\.safetensors", file):
            what = f"{str(file)[:60]!r} is not a safetensors file in the model's folder"
            raise PlgsError("model-outside", what, folder, _ANOTHER)
    for path in folder.glob("*.safetensors"):
        digest = path.resolve().name  # the hub's cache links to files that are called by their SHA-256
        if path.is_symlink() and re.fullmatch("[0-9a-f]{64}", digest) and digest_of(path) != digest:
            raise PlgsError("model-broken", "the model differs from the hub's", path.resolve(), "Delete this file.")
    return labels_of_config(config)


def _check_pin(pin: Path, pins: Mapping[str, Any], folder: Path) -> None:
    """Record the SHA-256 of a new revision's weights in the file ``pin``. Raises PlgsError if recorded ones differ."""
    weights = {path.name: digest_of(path) for path in sorted(folder.glob("*.safetensors"))}
    if (known := pins.get(folder.name)) is None:
        with suppress(OSError):  # a cache that others share may be read-only
            write_atomically(pin, json.dumps({**pins, folder.name: weights}, indent=1) + "\n")
    elif known != weights:
        what = f"the weights of revision {folder.name} are not those that were downloaded first"
        raise PlgsError("model-broken", what, pin, f"Delete {pin.parent}, then fetch it again with --download.")


def _ask_hub(hub: Any, model: str, revision: str | None) -> None:
    """Raise PlgsError if the hub does not answer or lacks the model, as a download would wait for a silent hub."""
    try:
        hub.model_info(model, revision=revision, timeout=_HUB_S)
    except Exception as error:  # of httpx, or of whatever the hub's library uses in its place
        fix = "Check the name and the connection, or name a folder that holds the model."
        what = f"huggingface.co does not offer the model ({type(error).__name__})"
        raise PlgsError("hub-silent", what, model, fix) from error


def _not_loaded(name: str, download: bool, error: Exception) -> PlgsError:
    if not download and not Path(name).is_dir():
        fix = "Add --download to fetch it from huggingface.co, or name a folder that holds it."
        return PlgsError("not-downloaded", "the model is not on this computer", name, fix, option="--download")
    lines = str(error).splitlines() or [type(error).__name__]
    what = f"the model cannot be loaded ({lines[0][:200]})"
    return PlgsError("model-unusable", what, name, _ANOTHER)


TABLE, FOLDER, MADE_BY, DETECTIONS = "panoptic.json", "panoptic", "made_by.json", "detections.json"
_OTHER_MASKS = ("m2f_semantics", "m2f_notta_semantics", "masks")
Progress = Callable[[int, int, int], object]
"""Called after each frame with the number done, the total, and the number made in this run. Its errors end the work."""


class Segmenter(Protocol):
    """A network: its ``name``, its classes, and the mask of a picture with its detections (see `Mask2Former`)."""

    @property
    def name(self) -> str: ...

    @property
    def labels(self) -> tuple[ClassLabel, ...]: ...

    def segment(self, colour: NDArray[np.uint8]) -> tuple[NDArray[np.int32], list[MadeSegment], list[Detection]]: ...


@dataclass(frozen=True)
class Job:
    """The folder of the masks, what of it is ours, whether an earlier run began them, and whether they are complete."""

    folder: Path
    own: OwnFiles
    is_begun: bool
    is_finished: bool

    @property
    def pictures(self) -> Path:
        return self.folder / FOLDER

    def discard_if_empty(self) -> None:
        """Remove the files of ``begin_job`` if there is no mask yet."""
        if not self.is_begun:
            self.own.discard()


def begin_job(folder: Path, model: str, frames: Sequence[Frame]) -> Job:
    """Begin in ``folder``, or continue there. Raises PlgsError for masks of other programs, another model or other
    photos, and overwrites nothing."""
    made_by, of_files = folder / FOLDER / MADE_BY, digests_of_files([(frame.colour_path,) for frame in frames])
    named = [*zip((frame.name for frame in frames), of_files, strict=True)]
    photos = sha256(repr(named).encode()).hexdigest() if all(of_files) else ""  # not known
    fix = "Remove these, or write into another folder."
    own = OwnFiles(folder).begin("masks", {"model": model}, among_others=True)
    if made_by.is_file():
        content = read_object(made_by, fix)
        if content.get("model") != model or content.get("frames") != len(frames):
            what = f"there are already masks of {content.get('frames')} frames by {content.get('model')}"
            raise PlgsError("other-masks", what, folder, fix)
        if photos and content.get("photos", "") not in ("", photos):
            raise PlgsError("photos-changed", "the photos have changed since masks of them were made here", folder, fix)
        return Job(folder, own, True, (folder / TABLE).is_file())
    others = [name for name in (TABLE, FOLDER, DETECTIONS, *_OTHER_MASKS) if (folder / name).exists()]
    if others:
        raise PlgsError("has-masks", f"there are masks already ({others[0]})", folder, fix)
    try:
        with own:
            write_atomically(made_by, json.dumps({"model": model, "frames": len(frames), "photos": photos}) + "\n")
    except OSError as error:
        what = f"this cannot be written ({error.strerror})"
        raise PlgsError("unwritable", what, folder, "Name another with -o.") from error
    return Job(folder, own, False, False)


def make_masks(scene: Scene, job: Job, network: Segmenter, progress: Progress) -> None:
    """Make the missing masks, then the table. Raises PlgsError, OSError."""
    with job.own:
        _make_masks(scene, job, network, progress)
    for frame in scene.frames:
        job.own.remove(job.pictures / f"{frame.name}.json")  # last, as a run that was killed before needs them
    job.own.complete()


def _make_masks(scene: Scene, job: Job, network: Segmenter, progress: Progress) -> None:
    made = 0
    for done, frame in enumerate(scene.frames, start=1):
        segments, picture = (job.pictures / f"{frame.name}{suffix}" for suffix in (".json", ".png"))
        if not (job.own.owns(segments) and job.own.owns(picture)):
            ids, found, detections = network.segment(frame.read_colour(None))
            # R + 256 G + 65536 B
            write_image(picture, np.stack([ids & 255, ids >> 8 & 255, ids >> 16 & 255], axis=-1).astype(np.uint8))
            seen = {"width": ids.shape[1], "height": ids.shape[0], "detections": [one.to_json() for one in detections]}
            listed = [one.to_json() | {"area": int((ids == one.id).sum())} for one in found]
            write_atomically(segments, json.dumps({"segments_info": listed, **seen}))
            made += 1
        progress(done, len(scene.frames), made)
    names = [frame.name for frame in scene.frames]
    masks, images, annotations = list[object](), list[object](), list[object]()
    for number, name in enumerate(names, start=1):
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
