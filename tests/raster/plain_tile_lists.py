"""The lists of what touches which tile, in plain torch: in the place of gsplat's operators where there is no GPU."""

from __future__ import annotations

import torch
from torch import Tensor

from engine.raster.blending.torch_tiles import TileLists
from engine.raster.conventions import Pinhole
from engine.raster.records import TILE


def list_tiles_plainly(first: Tensor, last: Tensor, depths: Tensor, pinhole: Pinhole) -> TileLists:
    """What ``cuda.list_by_gsplat`` gets from gsplat: every box against every tile."""
    order = torch.sort(depths, stable=True).indices
    lists = []
    for top in range(0, pinhole.height, TILE):
        for left in range(0, pinhole.width, TILE):
            corner = torch.tensor([left, top])
            touches = ((first[order] < corner + TILE) & (last[order] >= corner)).all(1)
            lists.append(order[touches])
    counts = torch.tensor([0] + [len(ids) for ids in lists])
    return TileLists(torch.cat(lists), counts.cumsum(0), pinhole.width, pinhole.height)
