"""Mask2Former from a folder or, with the user's consent, from Hugging Face's hub. transformers is imported late.

Only safetensors are read: no pickles, and no code that comes with a model.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..errors import PlgsError, lacks_part
from ..scene import ClassLabel, is_thing_by_name, nearest_tables, size_within
from .merging import MadeSegment, merge_queries

_LARGEST_SIDE = 1280
"""The largest number of pixels of a mask's longer side: networks see less than that anyway."""


@dataclass(frozen=True)
class Mask2Former:
    """A loaded network: its ``name`` on loading, and its classes as ``labels``."""

    name: str
    labels: tuple[ClassLabel, ...]
    network: Any
    processor: Any

    @torch.inference_mode()
    def segment(self, colour: NDArray[np.uint8]) -> tuple[NDArray[np.int32], list[MadeSegment]]:
        """The panoptic mask of a picture uint8 [H, W, 3] RGB: see ``merge_queries``."""
        height, width = colour.shape[:2]
        inputs = self.processor(images=colour, return_tensors="pt", input_data_format="channels_last")
        seen = self.network(pixel_values=inputs["pixel_values"])
        masks = _resized(seen.masks_queries_logits, inputs["pixel_values"].shape[-2:])
        valid = inputs["pixel_mask"][0]  # the rest is padding
        masks = masks[..., : int(valid[:, 0].sum()), : int(valid[0].sum())]
        width, height = size_within((width, height), (_LARGEST_SIDE, _LARGEST_SIDE))
        stuff = frozenset(label.id for label in self.labels if not label.is_thing)
        return merge_queries(seen.class_queries_logits[0], _resized(masks, (height, width))[0].sigmoid(), stuff)


def _resized(masks: torch.Tensor, size: tuple[int, ...]) -> torch.Tensor:
    return torch.nn.functional.interpolate(masks, size=tuple(size), mode="bilinear", align_corners=False)


def load_model(name: str, *, download: bool) -> Mask2Former:
    """Load the network in the folder ``name``, or the one of this name on the hub. Raises PlgsError.

    It is fetched only with ``download``; otherwise it has to be on this machine already.
    """
    _refuse_other_folders(name)
    if not download:  # transformers reads this when it is imported
        os.environ["HF_HUB_OFFLINE"] = "1"
    try:
        from safetensors import SafetensorError
        from transformers import Mask2FormerForUniversalSegmentation, Mask2FormerImageProcessorPil
        from transformers.utils import logging
    except ImportError as error:
        raise lacks_part(f"masks are made with the package transformers ({error})", name, "segment") from error
    logging.set_verbosity_error()
    logging.disable_progress_bar()
    place: dict[str, Any] = {"local_files_only": not download, "trust_remote_code": False}
    try:
        processor = Mask2FormerImageProcessorPil.from_pretrained(name, **place)
        network = Mask2FormerForUniversalSegmentation.from_pretrained(name, use_safetensors=True, **place)
    except (OSError, ValueError, KeyError, RuntimeError, SafetensorError) as error:
        raise _not_loaded(name, download, error) from error
    names: dict[Any, Any] = network.config.id2label or {}
    tables = nearest_tables(map(str, names.values()))
    labels = tuple(
        ClassLabel(int(number), str(word), is_thing_by_name(str(word), tables) is not False)
        for number, word in sorted(names.items())
    )
    return Mask2Former(name, labels, network.eval(), processor)


def _refuse_other_folders(name: str) -> None:
    """A folder has to hold a model in safetensors; a name looks like OWNER/MODEL."""
    folder = Path(name)
    if folder.is_dir():
        if not (folder / "config.json").is_file() or not any(folder.glob("*.safetensors")):
            fix = "Name a folder that transformers' save_pretrained wrote, with config.json and safetensors."
            raise PlgsError("there is no model in this folder", folder, fix)
    elif name.count("/") != 1 or name.startswith((".", "/", "~")):
        raise PlgsError("there is no such folder or model", name, "Name a folder, or a model as OWNER/NAME.")


def _not_loaded(name: str, download: bool, error: Exception) -> PlgsError:
    if not download and not Path(name).is_dir():
        fix = "Add --download to fetch it from huggingface.co, or name a folder that holds it."
        return PlgsError("the model is not on this computer", name, fix, option="--download")
    lines = str(error).splitlines() or [type(error).__name__]
    return PlgsError(f"the model cannot be loaded ({lines[0][:200]})", name, "Name another one, or fetch it again.")
