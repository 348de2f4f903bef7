"""A 3D view holds a room, whatever its shape and whatever the sidebar covers."""

from __future__ import annotations

from itertools import product
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from mathutils import Euler
from plgs.plgs_blender.viewport import frame_room


def area(width: int, height: int, bar: int) -> Any:
    regions = [
        SimpleNamespace(type="WINDOW", width=width, height=height, x=0),
        SimpleNamespace(type="UI", width=bar, height=height, x=width - bar),
    ]
    space = SimpleNamespace(lens=50.0, region_3d=SimpleNamespace())
    return SimpleNamespace(regions=regions, spaces=SimpleNamespace(active=space))


@pytest.mark.parametrize("size", [(19.0, 11.0, 3.0), (4.0, 4.0, 40.0), (1.0, 30.0, 2.0)])
@pytest.mark.parametrize(("width", "height", "bar"), [(1586, 928, 1), (1057, 840, 291), (500, 900, 200)])
def test_all_corners_are_in_the_free_part(size: tuple[float, ...], width: int, height: int, bar: int) -> None:
    corners = np.array(list(product(*((-2.0, side - 2.0) for side in size))))
    shown = area(width, height, bar)
    rotation = Euler((0.9, 0.0, 1.2)).to_quaternion()
    frame_room(shown, rotation, corners)
    view = shown.spaces.active.region_3d
    local = (corners - np.array(view.view_location)) @ np.array(view.view_rotation.to_matrix())
    seen = local[:, :2] / (view.view_distance - local[:, 2:]) * 50.0 / 36.0 * max(width, height) / 2.0  # in pixels
    covered = bar if bar > 1 else 0
    free = np.array([[-width / 2, -height / 2], [width / 2 - covered, height / 2]])
    assert (seen >= free[0]).all() and (seen <= free[1]).all()
    assert (np.ptp(seen, axis=0) / np.ptp(free, axis=0)).max() > 0.9
