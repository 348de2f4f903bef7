"""What nobody named belongs to an object near it or to none; votes count as evidence."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from engine.model.settling import REACH, NamedGaussians, OwnedPoints, gaussian_centres, settled, within_reach
from engine.model.structured import GaussianLabels, LabelChannels
from tests.model.some_scene import GAUSSIANS, some_scene

CHANNELS = LabelChannels((1, 5), (0, 7), (0, 5))
"""The labels are: class 1, class 5, instance 7 of class 5."""
CHAIR, CHAIR_7 = 1, 2


def test_an_object_reaches_no_farther_than_its_points() -> None:
    points = OwnedPoints(np.array([[0, 0, 0], [9, 0, 0]], np.float32), np.array([7, 0], np.int32))
    centres = np.array([[REACH - 0.01, 0, 0], [REACH + 0.01, 0, 0], [9, 0, 0]], np.float32)
    label = np.array([[CHAIR_7, 0]] * 3, np.int16)
    assert within_reach(label, centres, CHANNELS, points).tolist() == [[CHAIR_7, 0], [CHAIR, 0], [CHAIR, 0]]
    nobodys = points._replace(instance=np.zeros(2, np.int32))
    assert within_reach(label, centres, CHANNELS, nobodys).tolist() == [[CHAIR, 0]] * 3


def test_only_what_lies_within_masks_is_named() -> None:
    named = NamedGaussians(4)
    gaussian, weight = np.array([[[0, 1], [2, -1]]], np.int32), np.array([[[0.9, 0.05], [1.0, 0.0]]], np.float32)
    in_mask = np.array([[True, False]])
    named.add(SimpleNamespace(gaussian=gaussian, weight=weight), in_mask)
    assert named.are_named.tolist() == [True, True, False, False]
    for _ in range(20):
        named.add(SimpleNamespace(gaussian=gaussian[:, ::-1], weight=weight[:, ::-1]), in_mask)
    assert named.are_named.tolist() == [False, False, True, False]


def test_shares_become_evidence_where_masks_named_a_class() -> None:
    scene = replace(some_scene(CHANNELS.slot_ids), channels=CHANNELS)
    label = torch.tensor([[CHAIR_7, CHAIR, 0]] * GAUSSIANS, dtype=torch.int16)
    voted = GaussianLabels(label, torch.tensor([[0.6, 0.3, 0.1]] * GAUSSIANS))
    are_named = np.arange(GAUSSIANS) % 2 == 0
    points = OwnedPoints(gaussian_centres(scene.anchors)[:2] + 1000, np.array([7, 7], np.int32))
    after = settled(scene, voted, are_named, points)
    squares = np.array([0.36, 0.09, 0.01])
    assert after.share[0].tolist() == pytest.approx((squares / squares.sum()).tolist())
    assert after.share[1].tolist() == pytest.approx([0.6, 0.3, 0.1])
    assert after.label[0].tolist() == [CHAIR_7, CHAIR, 0] and after.label[1].tolist() == [CHAIR, CHAIR, 0]
    assert voted.label[1].tolist() == [CHAIR_7, CHAIR, 0]  # the votes themselves stay
