"""Networks of transformers that make masks: Mask2Former, OneFormer, EoMT (each query has a class and a mask), RF-DETR.
transformers' own post-processing works at 384x384 for any aspect ratio, and gives one id to several stuff segments."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from .errors import PlgsError
from .json_file import read_object
from .networks import ANOTHER, load_weights, loading, model_folder, quiet_transformers, refuse_nan
from .scene import ClassLabel, labels_of_config, size_within
from .segment import Detection, MadeSegment, Rounds, detections_of, merge_queries

_LARGEST_SIDE = 1280
"""Maximum pixels of a mask's longer side; networks work at a lower resolution anyway."""
_TASK = "the task is panoptic"  # OneFormer's token
_TASK_WORDS = 77  # and the length that its text encoder takes
_RF_DETR = "rf_detr"
_RF_DETR_SIDE = 560  # of its pictures, if no file says
Queries = tuple[torch.Tensor, torch.Tensor]
"""Class logits, float [Q, C + 1] with no object as the last class, and mask logits, float [Q, h, w], of the picture."""
Look = Callable[[NDArray[np.uint8]], Queries]


@dataclass(frozen=True)
class QueryNetwork:
    """A loaded segmentation network, with the ``name`` given to `load_model` and its classes, ``labels``. ``queries``
    maps a picture, uint8 [H, W, 3] RGB, to class and mask logits. ``rounds`` are minimum scores of queries."""

    name: str
    labels: tuple[ClassLabel, ...]
    queries: Look
    rounds: Rounds

    @torch.inference_mode()
    def segment(self, colour: NDArray[np.uint8]) -> tuple[NDArray[np.int32], list[MadeSegment], list[Detection]]:
        """Segment a picture, uint8 [H, W, 3] RGB. Returns segment ids, int32 [H, W] with 0 = none, the segments, and
        all likely queries, also those that have no pixels in the ids."""
        width, height = size_within((colour.shape[1], colour.shape[0]), (_LARGEST_SIDE, _LARGEST_SIDE))
        stuff = frozenset(label.id for label in self.labels if not label.is_thing)
        with loading(self.name, runs=True):
            classes, masks = self.queries(colour)
        for values in (classes, masks):
            refuse_nan(values, self.name)
        inside = _resized(masks[None], (height, width))[0].sigmoid()
        return *merge_queries(classes, inside, stuff, self.rounds), detections_of(classes, inside)


def _resized(masks: torch.Tensor, size: tuple[int, ...]) -> torch.Tensor:
    return torch.nn.functional.interpolate(masks, size=tuple(size), mode="bilinear", align_corners=False)


def load_model(name: str, *, download: bool, rounds: Rounds = (0.5,)) -> QueryNetwork:
    """Load the network in the folder ``name``, or of this name on the Hugging Face hub, fetched only with ``download``.
    ``rounds`` are the minimum scores of queries. Raises PlgsError if it is missing, broken or of another kind."""
    quiet_transformers(name, download, "segment", "masks are made")
    folder = model_folder(name, download=download)
    labels = labels_of_config(folder / "config.json")
    kind = str(read_object(folder / "config.json", ANOTHER).get("model_type"))
    if kind not in (*_PROCESSORS, _RF_DETR):
        what = f"this is a network of the kind {kind[:40]!r}, which makes no masks that are read here"
        raise PlgsError("model-kind", what, name, f"Name one of the kinds {', '.join((*_PROCESSORS, _RF_DETR))}.")
    look = _rf_detr(folder, name) if kind == _RF_DETR else _universal(kind, folder, name)
    return QueryNetwork(name, labels, look, rounds)


def _universal(kind: str, folder: Path, name: str) -> Look:
    """Load the network ``name``, in ``folder``, as transformers' model type ``kind``; return the function to run it."""
    import transformers

    limits: dict[str, Any] = {"local_files_only": True, "trust_remote_code": False}
    task: dict[str, torch.Tensor] = {}
    if kind == "oneformer":
        with loading(name):
            words = transformers.CLIPTokenizer.from_pretrained(folder, **limits)
        said = words(_TASK, padding="max_length", max_length=_TASK_WORDS, truncation=True, return_tensors="pt")
        task["task_inputs"] = said["input_ids"] * said["attention_mask"]  # as OneFormer's own processor does
    with loading(name):
        processor = getattr(transformers, _PROCESSORS[kind]).from_pretrained(folder, **limits)
    network = load_weights(transformers.AutoModelForUniversalSegmentation, folder, name)

    def queries(colour: NDArray[np.uint8]) -> Queries:
        how: dict[str, Any] = {"images": colour, "return_tensors": "pt", "input_data_format": "channels_last"}
        if task:
            how["task_inputs"] = ["panoptic"]
        if kind.startswith("eomt"):  # it pads, but does not return where
            height, width = processor(**how, do_pad=False)["pixel_values"].shape[-2:]
            pixels = processor(**how, do_pad=True)["pixel_values"]
        else:
            inputs = processor(**how)
            pixels, valid = inputs["pixel_values"], inputs["pixel_mask"][0]
            height, width = int(valid[:, 0].sum()), int(valid[0].sum())
        seen = network(pixel_values=pixels, **task)
        masks = _resized(seen.masks_queries_logits, pixels.shape[-2:])[..., :height, :width]  # the rest is padding
        return seen.class_queries_logits[0], masks[0]

    return queries


def _rf_detr(folder: Path, name: str) -> Look:
    """Load RF-DETR with masks from its ``folder``, and return the function that runs it. The network scores each class
    by a sigmoid; only the best class is kept, beside the score of "no object"."""
    import cv2
    from transformers import RfDetrForInstanceSegmentation

    network = load_weights(RfDetrForInstanceSegmentation, folder, name)
    path = folder / "preprocessor_config.json"
    told: dict[str, Any] = read_object(path, ANOTHER) if path.is_file() else {}
    with loading(name):
        size = dict(told.get("size") or {})
        width, height = (int(size.get(side, _RF_DETR_SIDE)) for side in ("width", "height"))
        cv2.resize(np.zeros((1, 1, 3), np.uint8), (width, height))  # raises an error if the size is impossible
        mean = np.array(told.get("image_mean", (0.485, 0.456, 0.406)), np.float32).reshape(3)
        spread = np.array(told.get("image_std", (0.229, 0.224, 0.225)), np.float32).reshape(3)

    def queries(colour: NDArray[np.uint8]) -> Queries:
        small = (cv2.resize(colour, (width, height), interpolation=cv2.INTER_AREA) / np.float32(255) - mean) / spread
        seen = network(pixel_values=torch.from_numpy(small).permute(2, 0, 1)[None])
        best, label = seen.logits[0, :, : network.config.num_labels].sigmoid().max(-1)
        classes = torch.full((len(best), network.config.num_labels + 1), -torch.inf)
        classes[torch.arange(len(best)), label] = best.clamp(1e-6).log()
        classes[:, -1] = (1.0 - best).clamp(1e-6).log()
        return classes, seen.pred_masks[0]

    return queries


_PROCESSORS = {
    "mask2former": "Mask2FormerImageProcessorPil",
    "oneformer": "OneFormerImageProcessorPil",
    "eomt": "EomtImageProcessorPil",
    "eomt_dinov3": "EomtImageProcessorPil",
}
"""What prepares pictures for networks with universal outputs, by the ``model_type`` of their config.json."""
