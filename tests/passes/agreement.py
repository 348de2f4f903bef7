"""Do the instance pass and Cryptomatte agree?"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import OpenEXR

from engine.passes.cryptomatte import CRYPTO_INSTANCE, RANKS, name_float
from engine.posed.names import matte_names
from engine.result_files import INSTANCES, read_instances

LEAST_PIXELS = 300


class Pair(NamedTuple):
    """An object in a frame: its pixels in the instance pass, those where its matte is above 0.5, and their IoU."""

    frame: str
    name: str
    shown: int
    in_matte: int
    iou: float


def pairs_of(lift: Path) -> list[Pair]:
    """All objects of a finished lift with at least LEAST_PIXELS in a baked frame, by id or by matte."""
    names = matte_names({one.id: one.name for one in read_instances(lift / "result" / INSTANCES)[1]})
    pairs: list[Pair] = []
    for path in sorted((lift / "result/passes").glob("*.exr")):
        with OpenEXR.File(str(path), separate_channels=True) as file:
            planes = {name: channel.pixels for name, channel in file.channels().items()}
        for one, name in names.items():
            matte = coverage_of(planes, CRYPTO_INSTANCE, name)
            shown, inside = planes["PLGS.Instance.V"] == one, matte > 0.5
            if max(shown.sum(), inside.sum()) >= LEAST_PIXELS:
                iou = float((shown & inside).sum() / (shown | inside).sum())
                pairs.append(Pair(path.stem, name, int(shown.sum()), int(inside.sum()), iou))
    return pairs


def coverage_of(planes: dict[str, np.ndarray], layer: str, name: str) -> np.ndarray:
    """What a matte of this name pulls from the rank channels, float32 [H, W]."""
    bits = np.float32(name_float(name))
    ranks = [
        (f"{layer}0{rank // 2}.{'rb'[rank % 2]}", f"{layer}0{rank // 2}.{'ga'[rank % 2]}") for rank in range(RANKS)
    ]
    return sum(np.where(planes[ids] == bits, planes[shares], np.float32(0)) for ids, shares in ranks)
