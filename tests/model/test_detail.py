"""Pictures with smaller pixels than the training pictures show what these showed, and not the cracks between it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from engine.model.detail import finest_pixels
from engine.model.render import render_view
from engine.scene import Camera
from tests.model.some_scene import CAMERA, some_scene


def test_the_smallest_pixel_that_shows_a_place() -> None:
    pose = np.eye(4)
    pose[2, 3] = 1.0
    near, narrow = CAMERA.at(pose), Camera(10, 10, 80.0, 80.0, 5.0, 5.0, np.eye(4))
    places = np.array([[0.0, 0, 2], [0.9, 0, 2], [0.9, 0, 3], [0, 0, 0.5], [0, 0, -1]])
    found = finest_pixels(places, [CAMERA, near, narrow])
    by_near, by_narrow = 1 / 40, 0.5 / 80
    np.testing.assert_allclose(found, [by_near, 2 / 40, 2 * by_near, by_narrow, 0.0], rtol=1e-6)
    assert not finest_pixels(places, []).any()


def test_a_picture_of_the_training_is_as_it_was() -> None:
    scene = some_scene((4, 9, 0, 0, 0))
    finest = torch.from_numpy(finest_pixels(scene.anchors.position.numpy(), [CAMERA]))
    for camera in (CAMERA, CAMERA.resized(20, 15)):
        before, after = render_view(scene, camera), render_view(replace(scene, finest=finest), camera)
        np.testing.assert_array_equal(after.image, before.image)


def test_a_larger_picture_has_no_more_cracks_than_those_of_the_training() -> None:
    scene = some_scene((4, 9, 0, 0, 0))
    scene.anchors.log_scale[:, 3:] -= 2.5  # thinner than a pixel
    finest = torch.from_numpy(finest_pixels(scene.anchors.position.numpy(), [CAMERA]))
    trained, large = render_view(scene, CAMERA), CAMERA.resized(160, 120)
    cracked, whole = (render_view(each, large).alpha for each in (scene, replace(scene, finest=finest)))
    assert cracked.mean() < 0.3 * trained.alpha.mean()
    assert whole.mean() == pytest.approx(trained.alpha.mean(), rel=0.05)
