"""Labels decoded once for all frames, and what becomes of voted labels that no mask named."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from engine.model import scene_labels as subject
from engine.model.render import render_view
from engine.model.scene_labels import VotedLabels, scene_labels, shown_probabilities
from engine.model.settling import REACH, NamedGaussians, OwnedPoints, gaussian_centres, settled, within_reach
from engine.model.structured import NO_OBJECT, SPARE, GaussianLabels, LabelChannels
from tests.model.some_scene import CAMERA, CLASS_IDS, GAUSSIANS, SHAPE, some_scene

SLOTS = [(4, 9, NO_OBJECT, SPARE, SPARE), (NO_OBJECT, 4, SPARE, 9, SPARE), (NO_OBJECT, *[SPARE] * 4), (1, 2, 3, 4, 0)]
CLASSES = st.sampled_from(CLASS_IDS)


def classes_of(slot_ids: tuple[int, ...]) -> tuple[int, ...]:
    """Some class for each instance."""
    return tuple(CLASS_IDS[slot % 3] if slot > 0 else 0 for slot in slot_ids)


@pytest.mark.parametrize("slot_ids", SLOTS)
@pytest.mark.parametrize("one_class", [False, True])
def test_drawing_with_stored_labels_gives_nearly_the_same_picture(
    slot_ids: tuple[int, ...], one_class: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is drawn from labels of finished Gaussians differs a little where objects are of one class: a product of
    means is no mean of products."""
    monkeypatch.setattr(subject, "CHUNK", 33)
    scene = some_scene(slot_ids, class_of_slot=classes_of(slot_ids) if one_class else ())
    labels = scene_labels(scene)
    assert labels is not None
    with_labels, without = render_view(scene, CAMERA, labels), render_view(scene, CAMERA)
    assert without.alpha.max() > 0.3
    instances = tuple(slot for slot in slot_ids if slot > 0)
    assert with_labels.instance_ids == without.instance_ids == instances
    for layer in ("image", "alpha", "depth"):
        assert np.array_equal(getattr(with_labels, layer), getattr(without, layer))
    np.testing.assert_allclose(with_labels.instance_coverage, without.instance_coverage, atol=1e-5)
    np.testing.assert_allclose(with_labels.class_coverage, without.class_coverage, atol=0.05 if one_class else 1e-5)
    for shown in (with_labels, without):
        assert shown.class_coverage.shape == (30, 40, 3)
        np.testing.assert_allclose(shown.class_coverage.sum(axis=2), shown.alpha, atol=1e-5)


def test_view_dependent_labels_are_not_stored() -> None:
    assert scene_labels(some_scene(SLOTS[0], replace(SHAPE, label_view_input=True))) is None


def test_too_many_labels_are_not_stored(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = some_scene((1, NO_OBJECT, SPARE, SPARE, SPARE))
    size = 4 * GAUSSIANS * (len(CLASS_IDS) + 1)
    monkeypatch.setattr(subject, "MOST_BYTES", size)
    assert scene_labels(scene) is not None
    monkeypatch.setattr(subject, "MOST_BYTES", size - 1)
    assert scene_labels(scene) is None


def softmaxed(random: np.random.Generator, shape: tuple[int, ...], alpha: torch.Tensor) -> torch.Tensor:
    logits = torch.from_numpy(random.normal(0, 3, shape))
    return logits.softmax(dim=-1) * alpha[..., None]


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000), st.lists(CLASSES, max_size=5), st.integers(0, 2))
def test_an_instances_probability_counts_for_its_own_class(seed: int, of_class: list[int], spare: int) -> None:
    random = np.random.default_rng(seed)
    slot_ids = (*range(1, len(of_class) + 1), NO_OBJECT, *[SPARE] * spare)
    order = random.permutation(len(slot_ids)).tolist()
    meanings = [(slot, of_class[slot - 1] if slot > 0 else 0) for slot in slot_ids]
    channels = LabelChannels(
        CLASS_IDS, tuple(meanings[place][0] for place in order), tuple(meanings[place][1] for place in order)
    )
    alpha = torch.from_numpy(random.uniform(0, 1, (4, 6)))
    classes = softmaxed(random, (4, 6, 3), alpha)
    slots = softmaxed(random, (4, 6, len(slot_ids)), alpha)
    shown = shown_probabilities(classes, slots, channels)
    assert shown.shape == (4, 6, 3 + len(of_class)) and (shown >= 0).all()
    by_class, instances = shown[..., :3], shown[..., 3:]
    torch.testing.assert_close(by_class.sum(dim=-1), alpha)
    torch.testing.assert_close(instances, slots[..., list(channels.instance_slots)])
    # What is not an object's is shared by the semantic channels; no class has less than its instances.
    alone = alpha - instances.sum(dim=-1)
    owned = torch.zeros_like(by_class)
    for place, slot in enumerate(channels.instance_slots):
        owned[..., CLASS_IDS.index(channels.class_of_slot[slot])] += instances[..., place]
    share = classes / classes.sum(dim=-1, keepdim=True)
    torch.testing.assert_close(by_class, owned + share * alone[..., None])


def test_without_one_class_per_object_probabilities_stay_as_decoded() -> None:
    channels = LabelChannels(CLASS_IDS, (8, NO_OBJECT, 9, SPARE))
    classes, slots = torch.tensor([[0.2, 0.3, 0.4]]), torch.tensor([[0.1, 0.2, 0.3, 0.3]])
    assert shown_probabilities(classes, slots, channels).tolist() == torch.cat([classes, slots[:, ::2]], 1).tolist()


CHANNELS = LabelChannels(CLASS_IDS, (4, 9, NO_OBJECT, SPARE), (7, 5, 0, 0))


def test_voted_shares_become_class_and_instance_probabilities() -> None:
    label = torch.tensor([[3, 0, 2], [4, 3, 1], [1, 0, 2]], dtype=torch.int16)
    share = torch.tensor([[0.5, 0.25, 0.25], [0.75, 0.25, 0.0], [0.0, 0.0, 0.0]])
    table = VotedLabels.of_scene(GaussianLabels(label, share), CHANNELS).of(torch.arange(len(label)))
    # classes 2, 5, 7, then the instances 4 (of class 7) and 9 (of class 5)
    assert table.tolist() == [[0.25, 0, 0.75, 0.5, 0], [0, 0.75, 0.25, 0.25, 0.75], [0] * 5]


def test_a_scene_with_voted_labels_ignores_its_label_decoders() -> None:
    scene = some_scene((4, 9, NO_OBJECT, SPARE, SPARE), class_of_slot=(7, 5, 0, 0, 0))
    label = torch.full((GAUSSIANS, 1), 4, dtype=torch.int16)
    voted = replace(scene, voted=GaussianLabels(label, torch.ones(GAUSSIANS, 1)))
    plain, shown = render_view(scene, CAMERA), render_view(voted, CAMERA)
    assert np.array_equal(plain.image, shown.image)
    np.testing.assert_allclose(shown.instance_coverage[..., 1], shown.alpha, atol=1e-5)
    np.testing.assert_allclose(shown.class_coverage[..., 1], shown.alpha, atol=1e-5)
    assert not shown.instance_coverage[..., 0].any() and not shown.class_coverage[..., [0, 2]].any()


ONE_OBJECT = LabelChannels((1, 5), (0, 7), (0, 5))
"""The labels are: class 1, class 5, instance 7 of class 5."""
CHAIR, CHAIR_7 = 1, 2


def test_an_object_extends_no_farther_than_its_points() -> None:
    points = OwnedPoints(np.array([[0, 0, 0], [9, 0, 0]], np.float32), np.array([7, 0], np.int32))
    centres = np.array([[REACH - 0.01, 0, 0], [REACH + 0.01, 0, 0], [9, 0, 0]], np.float32)
    label = np.array([[CHAIR_7, 0]] * 3, np.int16)
    assert within_reach(label, centres, ONE_OBJECT, points).tolist() == [[CHAIR_7, 0], [CHAIR, 0], [CHAIR, 0]]
    nobodys = points._replace(instance=np.zeros(2, np.int32))
    assert within_reach(label, centres, ONE_OBJECT, nobodys).tolist() == [[CHAIR, 0]] * 3


def test_gaussians_drawn_mostly_inside_masks_count_as_named() -> None:
    named = NamedGaussians(4)
    gaussian, weight = np.array([[[0, 1], [2, -1]]], np.int32), np.array([[[0.9, 0.05], [1.0, 0.0]]], np.float32)
    in_mask = np.array([[True, False]])
    named.add(SimpleNamespace(gaussian=gaussian, weight=weight), in_mask)
    assert named.are_named.tolist() == [True, True, False, False]
    for _ in range(20):
        named.add(SimpleNamespace(gaussian=gaussian[:, ::-1], weight=weight[:, ::-1]), in_mask)
    assert named.are_named.tolist() == [False, False, True, False]


def test_label_shares_are_sharpened_where_masks_named_a_gaussian() -> None:
    scene = replace(some_scene(ONE_OBJECT.slot_ids), channels=ONE_OBJECT)
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
