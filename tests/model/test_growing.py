"""Growing and pruning of anchors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from engine.model.anchors import Anchors, initial_anchors
from engine.model.growing import GrowthRules, GrowthStatistics, grow_and_prune

RULES = GrowthRules(keep_share=(1.0, 1.0, 1.0))


def grid(side: int = 3, k: int = 2) -> Anchors:
    axis = np.arange(side) * 0.1
    positions = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float32)
    feature = np.arange(len(positions), dtype=np.float32)[:, None].repeat(4, axis=1)
    return initial_anchors(
        positions, np.ones(len(positions), int), gaussians_per_anchor=k, feature=feature, voxel_size=0.1
    )


def watched(anchors: Anchors, opacity: float = 1.0) -> GrowthStatistics:
    statistics = GrowthStatistics.empty(anchors)
    statistics.visits += 100
    statistics.opacity += 100 * opacity
    statistics.drawn += 100
    return statistics


def round_of(
    anchors: Anchors, statistics: GrowthStatistics, most: int = 10_000, rules: GrowthRules = RULES
) -> tuple[torch.Tensor, Anchors]:
    result = grow_and_prune(
        anchors,
        statistics,
        rules,
        voxel_size=0.1,
        steps_between=100,
        random=np.random.default_rng(0),
        most_anchors=most,
    )
    return result.keep, result.grown


def test_transparent_anchors_go_and_the_others_stay() -> None:
    anchors = grid()
    statistics = watched(anchors)
    statistics.opacity[5] = 0.1
    keep, grown = round_of(anchors, statistics)
    assert not keep[5] and int(keep.sum()) == len(anchors) - 1
    assert len(grown) == 0


@pytest.mark.parametrize(("visits", "is_judged"), [(10, False), (11, True)])
def test_an_anchor_that_few_views_see_is_judged_after_the_least_visits(visits: int, is_judged: bool) -> None:
    """In a short lift of many views a visit is rare: shares of the steps would never be reached."""
    anchors = grid()
    anchors.offset[0, 0] = torch.tensor([30.0, 0.0, 0.0])
    anchors.log_scale[0] = np.log(0.1)
    rules = replace(RULES, least_visits=10)
    statistics = GrowthStatistics.empty(anchors)
    statistics.visits[5] = visits
    # Half as many sightings are enough to grow, as of the shares.
    statistics.drawn[0, 0] = visits * rules.seen_share / rules.visited_share
    statistics.gradient[0, 0] = 1.0
    keep, grown = round_of(anchors, statistics, rules=rules)
    assert bool(keep[5]) is not is_judged and int(keep.sum()) == len(anchors) - is_judged
    assert bool(len(grown)) is is_judged
    assert statistics.visits[5] == (0 if is_judged else visits)


def test_a_strong_gradient_grows_an_anchor_in_a_free_cell_with_the_greatest_feature() -> None:
    anchors = grid()
    anchors.offset[0, 0] = torch.tensor([30.0, 0.0, 0.0])
    anchors.offset[7, 1] = anchors.position[0] + torch.tensor([3.0, 0, 0]) - anchors.position[7]
    anchors.log_scale[0] = np.log(0.1)
    anchors.log_scale[7] = 0.0
    statistics = watched(anchors)
    statistics.gradient[0, 0] = 100 * 1e-2
    statistics.gradient[7, 1] = 100 * 1e-2
    _, grown = round_of(anchors, statistics)
    assert len(grown) >= 1
    assert (grown.initial_class == 0).all() and (grown.level > 0).all()
    nearest = (grown.position - torch.tensor([3.0, 0, 0])).norm(dim=1)
    assert nearest.min() < 0.9
    assert grown.feature[nearest.argmin()].max() == 7
    assert statistics.gradient[0, 0] == 0


def test_occupied_cells_grow_nothing() -> None:
    anchors = grid()
    statistics = watched(anchors)
    statistics.gradient += 100 * 1e-2
    _, grown = round_of(anchors, statistics)
    assert len(grown) == 0
