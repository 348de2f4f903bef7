"""Deciding pixels: classes, instances, how sure, and colour in linear light."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from engine.passes import decide, encoded, linear
from tests.passes.views import CHAIR, CLASSES, EDGE, LEFT, NOTHING, RIGHT, SOFA, WALL, made_rendering


def test_classes_and_instances() -> None:
    layers = decide(made_rendering(), CLASSES)
    assert layers.semantic[0].tolist() == [CHAIR, CHAIR, CHAIR, WALL, WALL, CHAIR, CHAIR, 0]
    assert layers.instance[0].tolist() == [3, 3, 3, 0, 0, 70001, 70001, 0]
    assert layers.confidence[0] == pytest.approx([1, 1, 0.6, 1, 1, 0.75, 0.75, 0])
    assert layers.depth[0] == pytest.approx([2.5] * 7 + [0])


def test_entropy_runs_from_sure_to_no_idea() -> None:
    rendering = made_rendering()
    rendering.class_coverage[0, 3] = 1 / 3
    layers = decide(rendering, CLASSES)
    assert layers.entropy[0, 0] == pytest.approx(0, abs=1e-6)
    assert layers.entropy[0, 3] == pytest.approx(1, abs=1e-6)
    assert 0 < layers.entropy[EDGE].min() < 1
    assert not layers.entropy[NOTHING].any()


def test_alpha_does_not_change_what_is_decided() -> None:
    rendering = made_rendering()
    thin = replace(
        rendering,
        alpha=rendering.alpha * 0.2,
        class_coverage=rendering.class_coverage * 0.2,
        instance_coverage=rendering.instance_coverage * 0.2,
    )
    full, faint = decide(rendering, CLASSES), decide(thin, CLASSES)
    assert (full.semantic == faint.semantic).all()
    assert faint.confidence == pytest.approx(full.confidence, abs=1e-5)


def test_an_object_is_of_one_class_throughout() -> None:
    layers = decide(made_rendering(), CLASSES, {70001: SOFA, 3: CHAIR, 99: CHAIR})
    assert (layers.semantic[RIGHT] == SOFA).all()
    assert layers.confidence[RIGHT] == pytest.approx(0.25)
    assert (layers.semantic[LEFT] == CHAIR).all()
    assert layers.semantic[0, 3] == WALL


def test_an_instance_cannot_impose_a_class_that_nothing_there_speaks_for() -> None:
    layers = decide(made_rendering(), CLASSES, {70001: WALL})
    assert (layers.semantic[RIGHT] == CHAIR).all()
    assert not layers.instance[RIGHT].any()


def test_a_likely_class_outweighs_a_little_more_coverage() -> None:
    """Where no instance was found the slots are arbitrary: the one of the pixel's own class is the better guess."""
    rendering = made_rendering()
    rendering.instance_coverage[RIGHT] = 0.0
    rendering.instance_coverage[RIGHT][..., list(rendering.instance_ids).index(3)] = 0.3
    rendering.instance_coverage[RIGHT][..., list(rendering.instance_ids).index(70001)] = 0.4
    layers = decide(rendering, CLASSES, {70001: SOFA, 3: CHAIR})
    assert (layers.semantic[RIGHT] == CHAIR).all() and (layers.instance[RIGHT] == 3).all()


def test_void_and_spare_slots_never_win_and_ties_go_to_the_lower_id() -> None:
    rendering = made_rendering()
    coverage = np.zeros((*rendering.alpha.shape, 3), np.float32)
    coverage[...] = (0.8, 0.1, 0.1)
    rendering = replace(rendering, class_ids=(0, SOFA, CHAIR), class_coverage=coverage, instance_ids=(0, 3))
    layers = decide(rendering, CLASSES)
    assert set(np.unique(layers.semantic)) == {0, CHAIR}
    assert (layers.semantic[NOTHING] == 0).all()
    assert set(np.unique(layers.instance)) <= {0, 3}
    assert layers.confidence[0, 0] == pytest.approx(0.5)


def test_combined_is_linear() -> None:
    layers = decide(made_rendering(), CLASSES)
    assert layers.combined[0, 0] == pytest.approx([0.2140411, 0.0508761, 1.0, 1.0], abs=1e-6)
    assert not layers.combined[NOTHING].any()
    ramp = np.linspace(0, 1, 101)
    assert encoded(linear(ramp)) == pytest.approx(ramp, abs=1e-6)
