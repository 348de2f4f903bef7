"""Labels voted onto Gaussians, against the gradient of a float64 rendering: what each takes part in a pixel."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from engine.instances.panoptic_labels import LEAST_OF_CLASS, PanopticLabels, decide_labels
from engine.model import label_voting
from engine.model.gaussians import decode
from engine.model.label_voting import (
    LABELS_HELD,
    PRIOR,
    Contributors,
    HeldVotes,
    LabelVotes,
    _add_votes,
    contributors,
    pixel_labels,
)
from engine.model.render import render_view
from engine.model.scene_labels import VotedLabels, scene_labels
from engine.model.structured import NO_OBJECT, SPARE, GaussianLabels, StructuredScene
from engine.presets.preset import EvidenceKind
from engine.scene import Camera
from tests.model.some_scene import CAMERA, CLASS_IDS, GAUSSIANS, SHAPE, mean_depth, some_scene
from tests.raster.reference import rasterize

SLOT_IDS, CLASS_OF_SLOT = (4, NO_OBJECT, 9, SPARE, SPARE), (7, 0, 5, 0, 0)
LABELS = len(CLASS_IDS) + 2
SIZE = (CAMERA.height, CAMERA.width)


@pytest.fixture(autouse=True)
def every_label(monkeypatch: pytest.MonkeyPatch) -> None:
    """Gaussians keep all labels."""
    monkeypatch.setattr(label_voting, "KEPT", LABELS)


UNKNOWN_DEPTH = np.zeros(SIZE, np.float32)


@pytest.fixture(scope="module")
def scene() -> StructuredScene:
    return some_scene(SLOT_IDS, class_of_slot=CLASS_OF_SLOT)


def moved(by: float) -> Camera:
    pose = CAMERA.camera_to_world.copy()
    pose[0, 3] += by
    return replace(CAMERA, camera_to_world=pose)


def made_up_labels(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(-1, LABELS, SIZE).astype(np.int16)


def blending_weights(scene: StructuredScene, camera: Camera, label: np.ndarray) -> np.ndarray:
    """Sum of each Gaussian's blending weights over the pixels of each label, float64 [G, L]: the gradient of a
    rendering of labels, summed where a pixel has the label, with respect to the Gaussians' labels."""
    drawn = decode(scene.anchors, scene.decoders, camera)
    learnt = (drawn.means, drawn.scales, drawn.quats, drawn.opacities, drawn.colours)
    own = torch.zeros(len(drawn.kept), LABELS, dtype=torch.float64, requires_grad=True)
    pose, intrinsics = torch.from_numpy(camera.camera_to_world), torch.from_numpy(camera.K)
    exact = (each.detach().double() for each in learnt)
    rendering = rasterize(*exact, own, pose, intrinsics, camera.width, camera.height, backend="reference")
    assert rendering.labels is not None
    wanted = torch.from_numpy(label[..., None] == np.arange(LABELS))
    (rendering.labels * wanted).sum().backward()
    k = scene.anchors.gaussians_per_anchor
    weights = np.zeros((GAUSSIANS, LABELS))
    assert own.grad is not None
    weights[drawn.visible[drawn.kept // k] * k + drawn.kept % k] = own.grad.numpy()
    return weights


def dense(voted: GaussianLabels) -> np.ndarray:
    """Shares by label, float32 [G, L]."""
    table = torch.zeros(len(voted.label), LABELS)
    return table.scatter_(1, voted.label.long(), voted.share).numpy()


def shares(votes: np.ndarray) -> np.ndarray:
    return votes / np.maximum(votes.sum(1, keepdims=True), 1e-8)


@pytest.mark.parametrize(("kind", "pixels", "resolution"), [("pixels", 1, 0), ("root", 0.5, 0), ("density", 0, 2)])
def test_votes_add_up_over_views(scene: StructuredScene, kind: EvidenceKind, pixels: float, resolution: float) -> None:
    """In two views of flat surfaces, one nearer than the other."""
    votes, expected = LabelVotes(scene, kind, 0.0), np.zeros((GAUSSIANS, LABELS))
    for seed, (camera, metres) in enumerate(((CAMERA, 2.0), (moved(0.3), 1.0))):
        label = made_up_labels(seed)
        votes.add(replace_depth(contributors(scene, camera, GAUSSIANS), metres), label, UNKNOWN_DEPTH)
        weights = blending_weights(scene, camera, label)
        own = np.maximum(weights.sum(1, keepdims=True), 1e-12) ** (pixels - 1)
        expected += weights * own * (0.01 * np.sqrt(camera.fx * camera.fy) / metres) ** resolution
    seen = expected.sum(1) > 1e-3
    assert seen.sum() > 30
    np.testing.assert_allclose(dense(votes.result())[seen], shares(expected)[seen], atol=2e-3)


def test_pixels_at_the_wrong_depth_do_not_vote(scene: StructuredScene) -> None:
    seen = contributors(scene, CAMERA, GAUSSIANS)
    label = made_up_labels(0)
    sensor = seen.depth.copy()
    sensor[:, ::3] += 0.9 * label_voting.DEPTH_GAP_M
    sensor[:, 1::3] += 1.1 * label_voting.DEPTH_GAP_M
    sensor[:5] = 0  # not measured
    votes = LabelVotes(scene, "pixels", 0.0)
    votes.add(seen, label, sensor)
    abstaining = label.copy()
    abstaining[5:, 1::3] = -1
    plain = LabelVotes(scene, "pixels", 0.0)
    plain.add(seen, abstaining, UNKNOWN_DEPTH)
    np.testing.assert_array_equal(dense(votes.result()), dense(plain.result()))


def test_the_depth_tolerance_of_voting_pixels_grows_with_distance(scene: StructuredScene) -> None:
    seen = contributors(scene, CAMERA, 8)
    far = replace_depth(seen, 20.0)
    label = np.zeros(SIZE, np.int16)
    for gap, voting in ((0.9, True), (1.1, False)):
        votes = LabelVotes(scene, "pixels", 0.0)
        sensor = np.full(SIZE, 20.0, np.float32)
        votes.add(replace_depth(far, 20.0 * (1 + gap * label_voting.DEPTH_GAP_SHARE)), label, sensor)
        assert bool(votes.result().share.any()) is voting


def replace_depth(view: Contributors, metres: float) -> Contributors:
    return replace(view, depth=np.full(SIZE, metres, np.float32))


def test_gaussians_without_votes_keep_their_decoded_labels(scene: StructuredScene) -> None:
    decoded = scene_labels(scene)
    assert decoded is not None
    silent = LabelVotes(scene, "pixels").result()
    shown = VotedLabels.of_scene(silent, scene.channels).of(torch.arange(len(silent.label)))
    torch.testing.assert_close(shown, decoded.probabilities, atol=1e-5, rtol=0)
    votes = LabelVotes(scene, "pixels")
    label = np.full(SIZE, 3, np.int16)
    votes.add(contributors(scene, CAMERA, GAUSSIANS), label, UNKNOWN_DEPTH)
    weight = blending_weights(scene, CAMERA, label).sum(1)
    prior = dense(silent)
    expected = (prior * PRIOR + weight[:, None] * (np.arange(LABELS) == 3)) / (PRIOR + weight)[:, None]
    np.testing.assert_allclose(dense(votes.result()), expected, atol=2e-3)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000))
def test_a_label_with_many_votes_is_never_dropped(seed: int) -> None:
    """One Gaussian, whose pixels show 200 labels; label 7 has more than a sixteenth of all votes."""
    random = np.random.default_rng(seed)
    label = random.integers(0, 200, 300).astype(np.int16)
    label[random.random(300) < 0.1] = 7
    held = HeldVotes(np.full((1, LABELS_HELD), -1, np.int16), np.zeros((1, LABELS_HELD), np.float32))
    one = np.zeros((1, 300, 1), np.int32)
    weight = np.ones((1, 300, 1), np.float32)
    _add_votes(one, weight, label[None], np.ones((1, 300), np.float32), np.float32(1.0), np.zeros(1, np.float32), held)
    everything = held.of_all_labels(0, 1, 200)[0]
    true = np.bincount(label, minlength=200)
    kept = everything > 0
    assert everything.sum() == 300 and kept.sum() == LABELS_HELD
    assert kept[true > 300 / LABELS_HELD].all() and (everything[kept] >= true[kept]).all()


def test_view_dependent_labels_skip_the_first_vote() -> None:
    """There is no one label that such a decoder would give a Gaussian."""
    dependent = some_scene(SLOT_IDS, replace(SHAPE, label_view_input=True), CLASS_OF_SLOT)
    assert not LabelVotes(dependent, "pixels").result().share.any()


def test_contributors_of_a_pixel_add_up_to_its_rendered_depth(scene: StructuredScene) -> None:
    seen, drawn = contributors(scene, CAMERA, 8), render_view(scene, CAMERA)
    solid = drawn.alpha > 0.31
    np.testing.assert_allclose(seen.depth[solid], mean_depth(scene, CAMERA)[solid], rtol=1e-5)
    assert not seen.depth[drawn.alpha < 0.29].any()
    assert (np.diff(seen.weight, axis=2) <= 0).all()
    np.testing.assert_array_equal(seen.gaussian < 0, seen.weight == 0)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_a_pixel_shows_the_labels_voted_for_its_gaussians(scene: StructuredScene, seed: int) -> None:
    random = np.random.default_rng(seed)
    label = np.stack([random.permutation(LABELS)[:3] for _ in range(20)])
    share = random.dirichlet([0.3] * 3, 20)
    voted = GaussianLabels(torch.from_numpy(label.astype(np.int16)), torch.from_numpy(share.astype(np.float32)))
    gaussian, weight = random.integers(0, 20, (5, 6, 4)), random.uniform(0, 0.25, (5, 6, 4))
    gaussian[np.arange(4) >= random.integers(0, 5, (5, 6, 1))] = -1
    weight = np.where(gaussian < 0, 0, weight)
    view = Contributors(gaussian, weight.astype(np.float32), np.ones((5, 6), np.float32), CAMERA)
    totals = np.zeros((5, 6, LABELS))
    for place in np.ndindex(gaussian.shape):
        if gaussian[place] >= 0:
            totals[place[:2]][label[gaussian[place]]] += weight[place] * share[gaussian[place]]
    panoptic = PanopticLabels(CLASS_IDS, (7, 5))
    expected, _ = decide_labels(totals.reshape(-1, LABELS), panoptic, LEAST_OF_CLASS)
    np.testing.assert_array_equal(pixel_labels(scene, voted, view).reshape(-1), expected)


def test_a_gaussian_keeps_only_its_likeliest_labels(scene: StructuredScene, monkeypatch: pytest.MonkeyPatch) -> None:
    found = []
    for kept in (2, LABELS + 3):
        monkeypatch.setattr(label_voting, "KEPT", kept)
        votes = LabelVotes(scene, "pixels")
        votes.add(contributors(scene, CAMERA, 8), made_up_labels(0), UNKNOWN_DEPTH)
        found.append(votes.result())
    few, all_of_them = found
    assert few.label.shape == few.share.shape == (GAUSSIANS, 2) and all_of_them.label.shape == (GAUSSIANS, LABELS)
    best = all_of_them.share[:, :2]
    torch.testing.assert_close(few.share, best / best.sum(1, keepdim=True))
    for each in (few, all_of_them):
        assert (each.share[:, 0] >= each.share[:, 1]).all()
        torch.testing.assert_close(each.share.sum(1), torch.ones(GAUSSIANS))
