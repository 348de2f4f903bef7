"""What baked Gaussians and anchors are said to be: no ghosts."""

from dataclasses import replace

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from engine.instances.panoptic_labels import LEAST_OF_CLASS
from engine.model.baking import BakedGaussians, bake, decided_labels
from engine.model.neural_gaussians import PanopticRendering
from engine.model.structured import NO_OBJECT, SPARE, GaussianLabels, LabelChannels
from engine.passes.layers import decide
from engine.scene import Camera, Category, ClassTable
from tests.model.some_scene import CLASS_IDS, GAUSSIANS, some_scene

WALL, CHAIR, SOFA = CLASS_IDS
THINGS = frozenset({CHAIR, SOFA})
ONE_CLASS = LabelChannels(CLASS_IDS, (4, NO_OBJECT, 9, SPARE), (SOFA, 0, CHAIR, 0))
OWN_CLASSES = LabelChannels(CLASS_IDS, (4, NO_OBJECT, 9, SPARE))


def decided(rows: list[list[float]], channels: LabelChannels = ONE_CLASS) -> list[tuple[int, int]]:
    class_id, instance_id = decided_labels(np.array(rows, np.float32), channels, THINGS)
    assert class_id.dtype == instance_id.dtype == np.int32
    return list(zip(class_id.tolist(), instance_id.tolist(), strict=True))


def test_a_gaussian_gets_the_object_with_most_of_its_class() -> None:
    # wall, chair, sofa; then the sofa 4 and the chair 9
    assert decided([[0.1, 0.9, 0, 0, 0], [0, 0.6, 0.4, 0.4, 0]]) == [(WALL, 0), (SOFA, 4)], "the next class"
    assert decided([[0, 0.6, 0.4, 0.4, 0.5]]) == [(CHAIR, 9)]
    little, enough = 0.8 * LEAST_OF_CLASS - 0.001, 0.8 * LEAST_OF_CLASS + 0.001
    assert decided([[0.2, 0.8, 0, 0, little], [0.2, 0.8, 0, 0, enough]]) == [(WALL, 0), (CHAIR, 9)]
    # Where every pixel decides for itself, "no object" is one of the choices.
    assert decided([[0, 1, 0, 0.4, 0.1], [0, 1, 0, 0.6, 0.1]], OWN_CLASSES) == [(CHAIR, 0), (CHAIR, 4)]


def test_gaussians_of_stuff_have_no_instance() -> None:
    assert decided([[0.9, 0.1, 0, 0.9]], LabelChannels(CLASS_IDS, (4, NO_OBJECT), (WALL, 0))) == [(WALL, 0)]
    assert decided([[0, 1, 0], [1, 0, 0]], LabelChannels(CLASS_IDS, (NO_OBJECT, SPARE))) == [(CHAIR, 0), (WALL, 0)]


TABLE = ClassTable(tuple(Category(one, str(one), one in THINGS, (0, 0, 0)) for one in CLASS_IDS))


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from([ONE_CLASS, OWN_CLASSES]))
def test_labels_of_single_gaussians_follow_the_rule_for_pixels(seed: int, channels: LabelChannels) -> None:
    random = np.random.default_rng(seed)
    owned = random.dirichlet([0.4] * 3, (8, 9))[..., :2]
    classes = random.dirichlet([0.4] * 3, (8, 9)) * (1 - owned.sum(-1, keepdims=True) * bool(channels.class_of_slot))
    if channels.class_of_slot:
        classes[..., CLASS_IDS.index(SOFA)] += owned[..., 0]
        classes[..., CLASS_IDS.index(CHAIR)] += owned[..., 1]
    shown = np.concatenate([classes, owned], axis=2).astype(np.float32)
    ones = np.ones((8, 9), np.float32)
    rendering = PanopticRendering(
        Camera(9, 8, 8.0, 8.0, 4.0, 3.0, np.eye(4)),
        np.zeros((8, 9, 3), np.float32),
        ones,
        ones,
        shown[..., :3],
        shown[..., 3:],
        CLASS_IDS,
        channels.shown_ids,
    )
    layers = decide(rendering, TABLE, {4: SOFA, 9: CHAIR} if channels.class_of_slot else None)
    class_id, instance_id = decided_labels(shown.reshape(-1, 5), channels, THINGS)
    np.testing.assert_array_equal(layers.semantic.reshape(-1), class_id)
    np.testing.assert_array_equal(layers.instance.reshape(-1), instance_id)


def test_exported_gaussians_have_the_voted_labels() -> None:
    """Every fourth anchor was voted to be wall, a chair of no object, chair 9, sofa 4."""
    scene = some_scene((4, NO_OBJECT, 9, SPARE, SPARE), class_of_slot=(SOFA, 0, CHAIR, 0, 0))
    of_anchor = np.resize(np.array([0, 1, 4, 3], np.int16), len(scene.anchors))
    k = scene.anchors.gaussians_per_anchor
    label = torch.from_numpy(np.repeat(of_anchor, k)[:, None].copy())
    scene = replace(scene, voted=GaussianLabels(label, torch.ones(GAUSSIANS, 1)))
    gaussians, anchors = bake(scene, np.zeros(3), THINGS)
    classes = np.array([WALL, CHAIR, 0, SOFA, CHAIR], np.int32)[of_anchor]
    instances = np.array([0, 0, 0, 4, 9], np.int32)[of_anchor]
    drawn = anchors.class_id > 0
    assert drawn.sum() > 40
    np.testing.assert_array_equal(anchors.class_id[drawn], classes[drawn])
    np.testing.assert_array_equal(anchors.instance_id[drawn], instances[drawn])
    assert not anchors.instance_id[~drawn].any() and not anchors.opacity[~drawn].any()
    pairs = set(zip(gaussians.class_id.tolist(), gaussians.instance_id.tolist(), strict=True))
    assert pairs == {(WALL, 0), (CHAIR, 0), (CHAIR, 9), (SOFA, 4)}


def test_exported_gaussians_are_widened_to_the_training_resolution() -> None:
    scene = some_scene((4, NO_OBJECT, 9, SPARE, SPARE), class_of_slot=(SOFA, 0, CHAIR, 0, 0))
    sharp, _ = bake(scene, np.zeros(3), THINGS)
    blurred, _ = bake(replace(scene, finest=torch.full((len(scene.anchors),), 0.02)), np.zeros(3), THINGS)
    np.testing.assert_allclose(blurred.scales, np.hypot(sharp.scales, np.sqrt(0.3) * 0.02), rtol=1e-5)


def test_a_nearly_transparent_gaussian_takes_the_colours_around_it() -> None:
    """Two grey clouds of scattered colours, and one nearly clear Gaussian of another colour amid the first."""
    random = np.random.default_rng(7)
    count = 40
    means = np.concatenate([random.uniform(0, 0.1, (2 * count, 3)), [[0.05, 0.05, 0.05]]]).astype(np.float32)
    means[count : 2 * count, 0] += 5.0
    light = np.repeat(np.array([0.2, 0.8, 0.2], np.float32), (count, count, 1))
    colours = light[:, None] + random.uniform(-0.2, 0.2, (2 * count + 1, 3)).astype(np.float32)
    colours[-1] = 1.0
    opacities = np.ones(len(means), np.float32)
    opacities[-1] = 1e-3
    ids = np.zeros(len(means), np.int32)
    blended = BakedGaussians(means, means, means, opacities, colours, ids, ids).blended_colours()
    assert blended.dtype == np.float32
    np.testing.assert_allclose(blended[:count], np.full((count, 3), 0.2), atol=0.15)
    assert blended[:count].std() < 0.5 * colours[:count].std()
    np.testing.assert_allclose(blended[count : 2 * count], np.full((count, 3), 0.8), atol=0.15)
    assert blended[-1].max() < 0.35


def test_exported_gaussians_leave_out_floaters() -> None:
    """A sheet of Gaussians on points that were seen; beside it one that nothing was seen near, one alone on a stray
    point, a faint one, and a lamp that hangs free."""
    grid = np.stack([*np.meshgrid(np.arange(20) * 0.05, np.arange(20) * 0.05), np.zeros((20, 20))], axis=-1)
    lamp = np.tile([0.5, 0.5, 1.0], (20, 1)) + np.random.default_rng(3).uniform(0, 0.1, (20, 3))
    others = np.array([[0.5, 0.5, 0.3], [3.0, 0.0, 0.0], [0.5, 0.5, 0.01]])
    means = np.concatenate([grid.reshape(-1, 3), lamp, others]).astype(np.float32)
    count = len(means)
    opacities = np.full(count, 0.8, np.float32)
    opacities[-1] = 0.01
    splats = BakedGaussians(
        means, np.full((count, 3), 0.02, np.float32), np.tile(np.float32([1, 0, 0, 0]), (count, 1)), opacities,
        np.zeros((count, 3), np.float32), np.arange(count, dtype=np.int32), np.zeros(count, np.int32),
    )  # fmt: skip
    kept = splats.without_floaters(np.concatenate([grid.reshape(-1, 3), lamp, others[1:2]]))
    np.testing.assert_array_equal(kept.class_id, np.arange(count - 3))
    assert not len(splats.without_floaters(np.zeros((0, 3))).means)
