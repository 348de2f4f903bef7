"""Deciding pixels: classes, instances, how sure, and colour in linear light."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from engine.instances.panoptic_labels import LEAST_OF_CLASS
from engine.model.neural_gaussians import PanopticRendering
from engine.passes.baked_view import ShownInstances, bake_view
from engine.passes.cryptomatte import CRYPTO_CLASS
from engine.passes.layers import STEPS, align_mattes, decide, encoded, linear
from engine.scene import Camera, Category, ClassTable
from tests.passes.views import CHAIR, CLASSES, LEFT, NOTHING, RIGHT, SOFA, WALL, made_rendering


def test_a_rendering_becomes_class_and_instance_ids() -> None:
    layers = decide(made_rendering(), CLASSES)
    assert layers.semantic[0].tolist() == [CHAIR, CHAIR, CHAIR, WALL, WALL, CHAIR, CHAIR, 0]
    assert layers.instance[0].tolist() == [3, 3, 3, 0, 0, 70001, 70001, 0]
    assert layers.confidence[0] == pytest.approx([1, 1, 0.6, 1, 1, 0.75, 0.75, 0], abs=0.5 / STEPS)
    assert layers.depth[0] == pytest.approx([2.5] * 7 + [0])


@pytest.mark.parametrize("wanted", [("semantic",), ("combined", "depth"), ("depth", "confidence")])
def test_pass_layers_that_are_not_requested_stay_empty(wanted: tuple[str, ...]) -> None:
    whole, part = decide(made_rendering(), CLASSES), decide(made_rendering(), CLASSES, wanted=wanted)
    for name in whole._fields:
        assert name not in wanted or (getattr(part, name) == getattr(whole, name)).all()
    assert not part.entropy.size and bool(part.combined.size) == ("combined" in wanted)


def with_right_chair(instances: dict[int, float]) -> PanopticRendering:
    """The right chair, 75 % chair and 25 % sofa, with other coverage of instances."""
    rendering = made_rendering()
    for column, one in enumerate(rendering.instance_ids):
        rendering.instance_coverage[RIGHT][..., column] = instances.get(one, 0.0)
    return rendering


def test_a_pixel_of_an_object_always_has_the_objects_class() -> None:
    layers = decide(made_rendering(), CLASSES, {70001: CHAIR, 3: CHAIR, 99: CHAIR})
    assert (layers.semantic[RIGHT] == CHAIR).all() and (layers.instance[RIGHT] == 70001).all()
    layers = decide(made_rendering(), CLASSES, {70001: SOFA, 3: CHAIR})
    assert (layers.semantic[RIGHT] == SOFA).all() and (layers.instance[RIGHT] == 70001).all()
    assert layers.confidence[RIGHT] == pytest.approx(0.25)
    assert (layers.semantic[LEFT] == CHAIR).all() and (layers.instance[LEFT] == 3).all()
    assert layers.semantic[0, 3] == WALL and layers.instance[0, 3] == 0


def test_a_thing_pixel_without_an_object_takes_the_object_that_covers_most() -> None:
    of_class = {3: CHAIR, 70001: SOFA}
    layers = decide(with_right_chair({}), CLASSES, of_class)  # nothing else is there
    assert (layers.semantic[RIGHT] == CHAIR).all() and not layers.instance[RIGHT].any()
    layers = decide(with_right_chair({70001: 0.25}), CLASSES, of_class)
    assert (layers.semantic[RIGHT] == SOFA).all() and (layers.instance[RIGHT] == 70001).all()
    rendering = with_right_chair({})
    rendering.class_coverage[RIGHT][..., rendering.class_ids.index(WALL)] = 0.01
    layers = decide(rendering, CLASSES, of_class)
    assert (layers.semantic[RIGHT] == WALL).all() and not layers.instance[RIGHT].any()
    layers = decide(with_right_chair({3: 0.2, 70001: 0.25}), CLASSES, of_class)
    assert (layers.semantic[RIGHT] == CHAIR).all() and (layers.instance[RIGHT] == 3).all()


def test_the_combined_pass_is_linear() -> None:
    layers = decide(made_rendering(), CLASSES)
    assert layers.combined[0, 0] == pytest.approx([0.2140411, 0.0508761, 1.0, 1.0], abs=1e-6)
    assert not layers.combined[NOTHING].any()
    ramp = np.linspace(0, 1, 101)
    assert encoded(linear(ramp)) == pytest.approx(ramp, abs=1e-6)


def coarse_rendering(seed: int, height: int = 23, width: int = 29) -> tuple[PanopticRendering, ClassTable]:
    """Coverages with many ties and exact sums; void and spare channels, unordered ids, some pixels empty."""
    random = np.random.default_rng(seed)
    classes, slots = int(random.integers(1, 12)), int(random.integers(0, 9))
    class_ids = random.permutation(20)[:classes] + (0 if seed % 3 else 1)
    class_ids[class_ids == 0] = 0 if classes > 1 else 20
    table = ClassTable(tuple(Category(int(one), str(one), bool(one % 2), (0, 0, 0)) for one in range(1, 22)))
    alpha = random.choice(np.array([0, 2**-11, 0.25, 1], np.float32), (height, width))
    by_class = random.integers(0, 4, (height, width, classes)).astype(np.float32) * alpha[..., None] / 8
    by_slot = random.integers(0, 4, (height, width, slots)).astype(np.float32) * alpha[..., None] / 8
    ids = [int(one) for one in random.permutation(30)[:slots]]  # 0 may be among them
    image = random.uniform(-0.1, 1.1, (height, width, 3)).astype(np.float32)
    camera = Camera(width, height, 8.0, 8.0, 4.0, 3.0, np.eye(4))
    wide = np.concatenate([by_class, by_slot], axis=2)  # channels of one picture lie side by side
    named = tuple(int(one) for one in class_ids)
    return PanopticRendering(camera, image, alpha, alpha * 3, wide[..., :classes], by_slot, named, tuple(ids)), table


def plain_decision(
    rendering: PanopticRendering, classes: ClassTable, owned: Mapping[int, int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Semantic, instance, confidence and entropy, pixel by pixel as the docstring of ``decide`` defines them."""
    order = sorted((one, c) for c, one in enumerate(rendering.class_ids) if one)
    slots = sorted((one, s) for s, one in enumerate(rendering.instance_ids) if one)
    shape = rendering.alpha.shape
    semantic, instance = np.zeros(shape, np.int32), np.zeros(shape, np.int32)
    confidence, entropy = np.zeros(shape), np.zeros(shape)
    for pixel in zip(*np.nonzero(rendering.alpha >= 1e-3), strict=True):
        coverage = np.array([rendering.class_coverage[pixel][c] for _, c in order])
        total = np.float32(0)
        for each in coverage:
            total += each
        probability = coverage / max(total, np.float32(1e-8))
        likely = {one: p for (one, _), p in zip(order, probability, strict=True)}
        by_slot = {one: rendering.instance_coverage[pixel][s] for one, s in slots}
        found = {}
        for shown in likely:
            weight, alone = by_slot, rendering.alpha[pixel]
            for each in weight.values():
                alone -= each
            if owned:
                weight = {one: w for one, w in weight.items() if owned.get(one) == shown}
                alone = np.float32(LEAST_OF_CLASS) * rendering.class_coverage[pixel][dict(order)[shown]]
            best = max(weight, key=lambda one: (weight[one], -one), default=0)
            is_owned = shown in classes.thing_ids and best and weight[best] > max(alone, 0)
            found[shown] = best if is_owned else 0
        able = [one for one in likely if found[one] or one not in classes.thing_ids] if owned else []
        able = [one for one in able if likely[one] > 0]
        shown = max(able or likely, key=lambda one: (likely[one], -one))
        semantic[pixel], instance[pixel], confidence[pixel] = shown, found[shown], likely[shown]
        terms = probability.astype(float) * np.log(np.maximum(probability, 1e-12).astype(float))
        entropy[pixel] = -terms.sum() / np.log(max(len(order), 2))
    return semantic, instance, confidence, entropy


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_pixel_labels_match_a_plain_implementation(seed: int) -> None:
    rendering, classes = coarse_rendering(seed)
    random = np.random.default_rng(seed + 1)
    of_things = {one: int(random.integers(1, 22)) for one in rendering.instance_ids if one and random.random() < 0.8}
    for owned in ({}, of_things):
        layers = decide(rendering, classes, owned)
        semantic, instance, confidence, entropy = plain_decision(rendering, classes, owned)
        assert (layers.semantic == semantic).all() and (layers.instance == instance).all()
        assert np.abs(layers.confidence - confidence).max() <= 0.5 / STEPS + 1e-6
        assert np.abs(layers.entropy - entropy).max() <= 0.5 / STEPS + 1e-6
    light = np.dstack([linear(rendering.image), rendering.alpha])
    np.testing.assert_allclose(layers.combined, light, atol=1e-6)


def test_pass_layers_of_a_rendering_without_classes_are_refused() -> None:
    with pytest.raises(ValueError, match="no classes"):
        decide(replace(made_rendering(), class_ids=(0,), class_coverage=np.zeros((6, 8, 1), np.float32)), CLASSES)


def test_class_coverage_without_an_object_goes_to_the_largest_object() -> None:
    rendering, of_class = with_right_chair({3: 0.2, 70001: 0.1}), {3: CHAIR, 70001: CHAIR}
    align_mattes(rendering, CLASSES, of_class, decide(rendering, CLASSES, of_class))
    assert rendering.instance_coverage[RIGHT][0, 0].tolist() == pytest.approx([0.65, 0.1])
    rendering = with_right_chair({3: 0.9 * LEAST_OF_CLASS * 0.75})
    align_mattes(rendering, CLASSES, of_class, decide(rendering, CLASSES, of_class))
    assert rendering.instance_coverage[RIGHT][0, 0, 0] == np.float32(0.9 * LEAST_OF_CLASS * 0.75)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_the_matte_of_a_pixels_id_is_above_one_half(seed: int) -> None:
    """And no other matte does, if objects have one class, whose coverage holds theirs."""
    rendering, classes = coarse_rendering(seed)
    random = np.random.default_rng(seed + 1)
    owned = {one: int(random.choice([c for c in rendering.class_ids if c])) for one in rendering.instance_ids}
    coverage = rendering.class_coverage
    for column, one in enumerate(rendering.class_ids):
        of_class = [slot for slot, instance in enumerate(rendering.instance_ids) if owned[instance] == one]
        coverage[..., column] += rendering.instance_coverage[..., of_class].sum(axis=-1)
    scale = rendering.alpha / np.maximum(coverage.sum(axis=-1), 1e-9)
    coverage *= scale[..., None]
    np.multiply(rendering.instance_coverage, scale[..., None], out=rendering.instance_coverage)
    view = bake_view([rendering], rendering.camera, classes, ShownInstances({}, owned))
    whole = rendering.alpha == 1
    shown = (view.layers.instance, view.layers.semantic)
    for matte, ids in zip(view.mattes, shown, strict=True):
        id_of = rendering.class_ids if matte.layer.name == CRYPTO_CLASS else rendering.instance_ids
        for name, column in zip(matte.layer.ids, matte.layer.columns, strict=True):
            covered = np.where(matte.ranks[::2] == name, matte.ranks[1::2], 0).sum(axis=0)
            assert ((covered > 0.5) == (ids == id_of[column]))[whole].all()
