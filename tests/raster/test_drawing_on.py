"""A device to draw on, wherever the tensors are."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from scenes import LAYERS, random_scene

from engine.raster import Rendering, drawing_on, interface, rasterize
from engine.raster.rendering import GaussianSet

SCENE = random_scene(2, 60, 3, 24, 18)
THERE = torch.device("meta")
"""A device that every machine has; nothing is computed on it."""


def draw(top_k: int = 0) -> Rendering:
    return rasterize(*SCENE.tensors, SCENE.pose, SCENE.intrinsics, 24, 18, top_k=top_k)


def test_the_cpu_is_where_the_tensors_are() -> None:
    plain = draw()
    with drawing_on("cpu"):
        chosen = draw()
    for layer in LAYERS:
        assert torch.equal(getattr(chosen, layer), getattr(plain, layer))


def test_everything_that_is_drawn_is_moved_to_the_device(monkeypatch: pytest.MonkeyPatch) -> None:
    plain, given = draw(), []

    def back_end(gaussians: GaussianSet, *rest: object) -> Rendering:
        given.extend(value.device for value in gaussians if value is not None)
        return plain

    def load(name: str) -> Callable[..., Rendering]:
        return back_end

    monkeypatch.setattr(interface, "_pick", lambda backend, means: f"for {means.device}")
    monkeypatch.setattr(interface, "_load", load)
    with pytest.raises(KeyError, match="within"), drawing_on(THERE):
        draw()
        raise KeyError("within")
    assert given == [THERE] * 6
    draw()
    assert given[6:] == [torch.device("cpu")] * 6, "after it all is as before"
    with drawing_on(THERE):
        draw(top_k=2)
    assert given[12:] == [torch.device("cpu")] * 6, "contributors are listed on the CPU"


def test_all_layers_come_back_but_the_leaf_with_the_gradient() -> None:
    drawn = draw(top_k=2)
    back = interface._moved(drawn, THERE)
    for layer in (*LAYERS, "visible", "top_indices", "top_weights"):
        assert getattr(back, layer).device == THERE and getattr(back, layer).shape == getattr(drawn, layer).shape
    assert back.means2d is drawn.means2d
