"""Properties that hold for any scene."""

from __future__ import annotations

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import Scene, random_scene

from engine.raster import Rendering, rasterize

scenes = st.builds(
    random_scene,
    seed=st.integers(0, 10_000),
    count=st.integers(0, 60),
    channels=st.just(3),
    width=st.integers(1, 40),
    height=st.integers(1, 40),
)


def draw(scene: Scene) -> Rendering:
    return rasterize(*scene.tensors, scene.pose, scene.intrinsics, scene.width, scene.height)


@settings(max_examples=25, deadline=None)
@given(scenes)
def test_blending_weights_sum_to_alpha(scene: Scene) -> None:
    ones = scene.changed(4, torch.ones_like(scene.tensors[4]))
    out = draw(ones)
    assert (out.alpha >= 0.0).all() and (out.alpha <= 1.0).all()
    torch.testing.assert_close(out.image, out.alpha[:, :, None].expand_as(out.image), rtol=0, atol=1e-5)


@settings(max_examples=25, deadline=None)
@given(scenes)
def test_labels_are_blended_as_colours(scene: Scene) -> None:
    out = draw(scene.changed(5, scene.tensors[4]))
    torch.testing.assert_close(out.labels, out.image, rtol=0, atol=1e-5)


@settings(max_examples=25, deadline=None)
@given(scenes, st.randoms(use_true_random=False))
def test_order_of_the_input_does_not_matter(scene: Scene, random: object) -> None:
    count = scene.tensors[0].shape[0]
    order = torch.from_numpy(np.random.default_rng(0).permutation(count))
    shuffled = Scene(
        tuple(tensor[order] for tensor in scene.tensors),
        scene.pose,
        scene.intrinsics,
        scene.width,
        scene.height,
    )
    assert torch.equal(draw(scene).image, draw(shuffled).image)


@settings(max_examples=25, deadline=None)
@given(scenes, st.floats(0.1, 10.0))
def test_length_of_quaternions_does_not_matter(scene: Scene, factor: float) -> None:
    longer = draw(scene.changed(2, scene.tensors[2] * factor))
    assert (longer.image - draw(scene).image).abs().mean() < 1e-5
