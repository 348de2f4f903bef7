"""What a mask reader gives: the masks of a scene's frames, of whichever kind they are."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from .classes import ClassTable
from .frame import PanopticMask, Size

READ_FIX = "Give masks with --masks, such as COCO panoptic ones, or make them: python -m engine segment SCENE."


@dataclass(frozen=True)
class MaskSet:
    """The masks of a scene's frames: the class table, one reader a frame, their sizes by frame, and warnings."""

    classes: ClassTable
    readers: Mapping[str, Callable[[Size | None], PanopticMask]]
    sizes: Mapping[str, Size]
    paths: Mapping[str, Path]
    warnings: tuple[str, ...] = ()


NO_MASKS = MaskSet(ClassTable(()), {}, {}, {})
