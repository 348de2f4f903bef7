"""What an anchor starts with, how anchors grow and are pruned, and the Gaussians that are decoded of them."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from engine.model.anchors import Anchors, AnchorsInView, initial_anchors, seeded_features, spacing
from engine.model.decoders import Decoders, DecoderShape
from engine.model.gaussians import decode_rows, visible_anchors
from engine.model.growing import GrowthRules, GrowthStatistics, grow_and_prune
from engine.scene import Camera

CAMERA = Camera(64, 48, 50.0, 50.0, 32.0, 24.0, np.eye(4))


def some_anchors(positions: list[list[float]], features: int = 8, k: int = 4) -> Anchors:
    feature = np.random.default_rng(0).normal(size=(len(positions), features)).astype(np.float32)
    of_level = np.ones(len(positions), int)
    return initial_anchors(
        np.array(positions, np.float32), of_level, gaussians_per_anchor=k, feature=feature, voxel_size=0.05
    )


def test_only_anchors_inside_the_view_are_decoded() -> None:
    anchors = some_anchors([[0, 0, 2], [0, 0, -2], [9, 0, 2], [0.2, 0.1, 3], [0, 0, 0.1]])
    assert visible_anchors(anchors, CAMERA).tolist() == [0, 3]


@pytest.mark.parametrize("label_view_input", [False, True])
def test_labels_depend_on_the_view_direction_only_when_asked(label_view_input: bool) -> None:
    anchors = some_anchors([[0, 0, 2], [0.2, 0.1, 3]])
    decoders = Decoders(DecoderShape(8, 4, 3, 5, distance_input=True, label_view_input=label_view_input), seed=1)
    with torch.no_grad():
        decoders.opacity.get_parameter("2.bias").fill_(9.0)  # all Gaussians are drawn, whoever looks
    rows = torch.arange(2)
    places = torch.zeros(3), torch.tensor([0.0, 5.0, 1.0])
    first, second = (decode_rows(AnchorsInView(anchors, rows, place), decoders).labels for place in places)
    assert torch.equal(first, second) is not label_view_input


def features_of(labels: np.ndarray, features: int = 32, seed: int = 0) -> np.ndarray:
    rgb = np.zeros((len(labels), 3), np.uint8)
    return seeded_features(rgb, np.zeros_like(labels), labels, features=features, seed=seed)


def test_initial_features_encode_colour_and_label() -> None:
    rgb = np.array([[0, 0, 0], [255, 255, 255]], np.uint8)
    feature = seeded_features(rgb, np.array([0, 2]), np.array([0, 1]), features=11, seed=3)
    assert feature.dtype == np.float32 and feature.shape == (2, 11)
    np.testing.assert_array_equal(feature[:, :3], [[-1] * 3, [1] * 3])
    assert not feature[0, 3:].any() and (np.abs(feature[1, 3:]) == 1).all()


def test_no_two_instances_share_a_feature_code() -> None:
    labels = np.arange(1, 129)
    for seed in range(4):
        # 8 bits for 128 instances: drawn at will, dozens of them would be alike.
        assert len(np.unique(features_of(labels, features=18, seed=seed), axis=0)) == len(labels)


def test_feature_codes_repeat_when_there_are_more_labels_than_codes() -> None:
    assert len(np.unique(features_of(np.arange(1, 10), features=5), axis=0)) == 2


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


def test_pruning_removes_only_transparent_anchors() -> None:
    anchors = grid()
    statistics = watched(anchors)
    statistics.opacity[5] = 0.1
    keep, grown = round_of(anchors, statistics)
    assert not keep[5] and int(keep.sum()) == len(anchors) - 1
    assert len(grown) == 0


@pytest.mark.parametrize(("visits", "is_judged"), [(10, False), (11, True)])
def test_an_anchor_seen_by_few_views_is_pruned_after_enough_visits(visits: int, is_judged: bool) -> None:
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


def test_a_strong_gradient_adds_an_anchor_in_a_free_cell() -> None:
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


def test_no_anchors_are_added_in_occupied_cells() -> None:
    anchors = grid()
    statistics = watched(anchors)
    statistics.gradient += 100 * 1e-2
    _, grown = round_of(anchors, statistics)
    assert len(grown) == 0


def test_point_spacing_is_the_rms_distance_to_three_neighbours() -> None:
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]], np.float32)
    assert spacing(points)[0] == pytest.approx(np.sqrt((1 + 4 + 9) / 3))
