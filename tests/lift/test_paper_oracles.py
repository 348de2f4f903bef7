"""The preset "paper" against plain computations that were written from the paper's text alone, section by section."""

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.ndimage import correlate1d
from scipy.optimize import linear_sum_assignment

from engine.instances.matching import update_instances
from engine.instances.records import ObjectMask, OrientedBox, SceneObject
from engine.model.torch_decoding import cluster_loss
from engine.presets.preset import PRESETS
from engine.scene import PanopticMask, Segment
from engine.semantics.consistency import ConsistencyOptions, consistency_masks, pseudo_labels
from engine.semantics.point_cloud import CloudOptions, build_point_cloud, voxelise
from engine.train.label_losses import ThingSegments, assigned_slots, label_losses
from engine.train.self_training import pseudo_label_steps
from engine.train.similarity import PhotoMoments
from engine.train.trainer import reconstruction_loss
from tests.semantics.plane_views import CHAIR, CLASS_IDS, SIZE, SOFA, WALL, wall_view
from tests.train.tiny_lift import TinyTrainer, prepared_for, views_of

PAPER = PRESETS["paper"]
SEEDS = pytest.mark.parametrize("seed", range(4))
ONE_PIXEL = 3.0 / 40.0
"""Metres between two cameras of ``wall_view`` whose pictures of the wall are one pixel apart."""


@SEEDS
def test_a_pixels_label_is_consistent_if_all_neighbouring_views_agree(seed: int) -> None:
    """Section "Consistency-enhanced 2D Mask Generation": q is the product over all pixels that are warped there."""
    random, width = np.random.default_rng(seed), SIZE[0]
    labels = np.where(random.random((5, *SIZE[::-1])) < 0.1, SOFA, WALL)
    views = [wall_view(str(n), ONE_PIXEL * n, classes=labels[n]) for n in range(5)]
    q = np.ones(SIZE[::-1], bool)
    for n, v, u in itertools.product((0, 1, 3, 4), range(SIZE[1]), range(width)):
        warped = u + n - 2
        if 0 <= warped < width and labels[n, v, u] != labels[2, v, warped]:
            q[v, warped] = False
    options = ConsistencyOptions(PAPER.neighbours, PAPER.agreement)
    np.testing.assert_array_equal(list(consistency_masks(views, options))[2], q)


@SEEDS
def test_the_cloud_holds_every_pixel_and_clusters_take_the_majority_label(seed: int) -> None:
    """Section "Robust Semantic Anchor Point Discovery", and the equation of V."""
    random = np.random.default_rng(seed)
    views = [
        wall_view(str(n), 0.3 * n, 3 + random.random(SIZE[::-1]), random.choice([WALL, CHAIR, SOFA], SIZE[::-1]))
        for n in range(2)
    ]
    options = CloudOptions(0.3, 10**6, 0.0, PAPER.evidence.points, PAPER.most_pixels)
    cloud = build_point_cloud(views, [np.ones(SIZE[::-1], bool)] * 2, CLASS_IDS, options)
    votes = np.zeros((len(cloud), 10))
    for view in views:
        for (v, u), d in np.ndenumerate(view.depth):
            ray = np.array([(u + 0.5 - 20) / 40, (v + 0.5 - 15) / 40, 1.0])
            world = view.camera.camera_to_world @ np.append(ray * d, 1.0)
            nearest = ((cloud.xyz - world[:3]) ** 2).sum(1).argmin()
            votes[nearest, view.mask.ids[v, u]] += 1
    assert votes.sum() == cloud.votes.sum() == 2 * SIZE[0] * SIZE[1]
    np.testing.assert_array_equal(cloud.class_id, votes.argmax(1))
    anchors = {tuple(round(float(x) / 0.25) for x in point) for point in cloud.xyz}
    np.testing.assert_allclose(voxelise(cloud.xyz, 0.25), 0.25 * np.array(sorted(anchors)), rtol=1e-6)


def test_the_cluster_loss_averages_over_all_gaussians_of_all_anchors() -> None:
    """Equation "Cluster Loss"."""
    random = np.random.default_rng(0)
    logits, labels = random.normal(size=(6, 10, 4)), random.integers(0, 4, 6)
    total = 0.0
    for anchor, k in np.ndindex(6, 10):
        y = np.exp(logits[anchor, k]) / np.exp(logits[anchor, k]).sum()
        total -= np.log(y[labels[anchor]])
    loss = cluster_loss(torch.from_numpy(logits), torch.from_numpy(labels))
    assert loss.item() == pytest.approx(total / (6 * 10))


@SEEDS
def test_each_connected_region_takes_its_most_rendered_class(seed: int) -> None:
    """Section "Self-training with Consistency-enhanced Segments"."""
    random = np.random.default_rng(seed)
    classes = np.kron(random.choice([WALL, CHAIR, SOFA], (4, 6)), np.ones((5, 5), int)).astype(np.int32)
    rendered = random.choice([WALL, CHAIR, SOFA], classes.shape).astype(np.int32)
    expected, left = np.zeros_like(classes), {*np.ndindex(classes.shape)}
    while left:
        region, grown = [], [left.pop()]
        while grown:
            v, u = grown.pop()
            region.append((v, u))
            for near in ((v - 1, u), (v + 1, u), (v, u - 1), (v, u + 1)):
                if near in left and classes[near] == classes[v, u]:
                    left.remove(near)
                    grown.append(near)
        count = [sum(rendered[pixel] == x for pixel in region) for x in range(10)]
        for pixel in region:
            expected[pixel] = int(np.argmax(count))
    mask = PanopticMask(classes, tuple(Segment(x, x, x != WALL) for x in (WALL, CHAIR, SOFA)))
    np.testing.assert_array_equal(pseudo_labels(mask, rendered, PAPER.segments.least_region), expected)


def cost(local: OrientedBox, known: OrientedBox) -> float:
    low = np.maximum(local.centre - local.size / 2, known.centre - known.size / 2)
    high = np.minimum(local.centre + local.size / 2, known.centre + known.size / 2)
    inter, one, two = np.prod(np.maximum(high - low, 0)), np.prod(local.size), np.prod(known.size)
    return float(-inter / (one + two) - inter / min(one, two))


def least_volume(points: np.ndarray) -> float:
    """Of all boxes about z; a side of the smallest one passes through two of the points."""
    seen = points[:, 0] + 1j * points[:, 1]
    turned = seen[:, None] * np.exp(-1j * np.angle(seen[:, None] - seen).ravel())
    return float((np.ptp(turned.real, 0) * np.ptp(turned.imag, 0)).min() * np.ptp(points[:, 2]))


def one_box(random: np.random.Generator, number: int) -> SceneObject:
    points = random.uniform(0, 2, 3) + np.array([*np.ndindex(2, 2, 2)]) * random.uniform(0.3, 1.5, 3)
    low, high = points.min(0), points.max(0)
    mask = ObjectMask(str(number), Segment(number, CHAIR, True), 50)
    return SceneObject(number, (mask,), CHAIR, points, OrientedBox((low + high) / 2, high - low, 0.0))


@pytest.mark.parametrize(("rule", "most"), [("literal", -1e-9), (PAPER.matching.rule, PAPER.matching.tau_new)])
def test_adding_a_view_updates_instances_as_the_papers_algorithm_1(rule: str, most: float) -> None:
    """Algorithm 1. Left out: partners of cost 0, which are ties, and those that the preset's own rule replaces."""
    random, told, joined = np.random.default_rng(0), replace(PAPER.matching, rule=rule), 0
    for _ in range(300):
        known = [one_box(random, n) for n in range(1, 5)]
        local = [one_box(random, n) for n in range(11, 11 + int(random.integers(1, 4)))]
        table = [[cost(one.box, g.box) for g in known] for one in local]
        best = min(itertools.permutations(range(4), len(local)), key=lambda p: sum(map(lambda r, g: r[g], table, p)))
        target = [None if min(row) > told.tau_new else g for row, g in zip(table, best, strict=True)]
        if any(g is not None and table[n][g] > most for n, g in enumerate(target)):
            continue
        joined += sum(g is not None for g in target)
        found = update_instances(known, local, 1e-6, told)
        assert len(found) == 4 + target.count(None)
        for g in range(4):
            own = [known[g], *(one for one, chosen in zip(local, target, strict=True) if chosen == g)]
            assert {mask.frame for mask in found[g].masks} == {mask.frame for one in own for mask in one.masks}
            together = np.concatenate([one.points for one in own])
            assert len(found[g].points) == len(together)
            if len(own) > 1:
                assert found[g].box.volume == pytest.approx(least_volume(together), rel=1e-4)
    assert joined > 100


def test_only_pixels_of_things_have_an_instance_target(tmp_path: Path) -> None:
    """The end of "Consistent Instance Mask Generation"; our choice: the nearest point, at most 2 voxels off."""
    views, classes = views_of(tmp_path)
    paper = replace(PAPER, voxel_size=0.1)
    prepared = prepared_for(views, classes, paper, tmp_path)
    cloud, owner, channels = prepared.cloud, prepared.instance_of_point, prepared.scene.channels
    labelled, owned = np.flatnonzero(cloud.class_id), np.flatnonzero(owner)
    view, target, taught = views[2], prepared.targets[2], 0
    world = view.camera.unproject(view.depth)
    for v, u in itertools.product(range(0, len(world), 3), range(0, len(world[0]), 3)):
        distance = np.linalg.norm(cloud.xyz - world[v, u], axis=1)
        shown, instance = labelled[distance[labelled].argmin()], owned[distance[owned].argmin()]
        slot = -1
        if cloud.class_id[shown] in classes.thing_ids and distance[instance] <= 2 * paper.voxel_size:
            slot = channels.slot_ids.index(owner[instance])
        assert target.slot[v, u] == slot
        taught += slot >= 0
    assert taught > 20

    # Section "Implementation Details": 30k steps, with pseudo labels after each 5k, the first after the initial stage.
    rounds = pseudo_label_steps(PAPER.schedule.self_training_every, PAPER.steps)
    assert PAPER.matching.tau_new == -0.1 and PAPER.steps == 30_000 and rounds == {*range(5_000, 30_000, 5_000)}
    trainer = TinyTrainer(prepared.scene, prepared.targets, views, replace(paper, steps=12), 0)
    for n in range(3):
        step = trainer.step()
        assert all((trainer.target(view).pseudo is None) == (n < 2) for view in range(len(views)))
        parts = step.reconstruction + 0.2 * step.semantic + 0.2 * step.instance
        assert step.semantic > 0 and step.instance > 0 and step.loss == pytest.approx(parts, rel=1e-5)


def test_the_reconstruction_loss_is_l1_ssim_and_volume() -> None:
    """Section "Loss Functions", with D-SSIM = 1 - SSIM, of Gaussian windows of 11 pixels."""
    random, window = np.random.default_rng(0), np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)

    def blurred(x: np.ndarray) -> np.ndarray:
        for axis in (0, 1):
            x = correlate1d(x, window / window.sum(), axis, mode="constant")
        return x

    x, y = random.random((2, 24, 32, 3))
    mx, my = blurred(x), blurred(y)
    sx, sy, sxy = blurred(x * x) - mx**2, blurred(y * y) - my**2, blurred(x * y) - mx * my
    ssim = (2 * mx * my + 0.01**2) * (2 * sxy + 0.03**2) / ((mx**2 + my**2 + 0.01**2) * (sx + sy + 0.03**2))
    scales = random.random((7, 3))
    expected = abs(x - y).mean() + 0.2 * (1 - ssim.mean()) + 0.001 * sum(a * b * c for a, b, c in scales)
    given = [torch.from_numpy(each).float() for each in (x, y, scales)]
    weights = {"ssim_weight": PAPER.weights.ssim, "volume_weight": PAPER.weights.volume}
    loss = reconstruction_loss(given[0], PhotoMoments.of(given[1]), given[2], photo_weight=1.0, **weights)
    assert loss.item() == pytest.approx(expected, rel=1e-4)


def test_linear_assignment_matches_segments_and_slots_by_iou() -> None:
    """Section "Consistent Instance Mask Generation", where the mean probability (the engine's cost) chooses alike."""
    random, compared = np.random.default_rng(0), 0
    for _ in range(100):
        segment, slot = random.integers(-1, 3, 20).repeat(9), random.integers(0, 3, 20).repeat(9)
        one, two = np.eye(4)[segment][:, :3], np.eye(3)[slot]
        both, areas = one.T @ two, np.maximum(one.sum(0)[:, None], 1)
        costs = -both / (areas + two.sum(0) - both), -both / areas
        chosen, other = (linear_sum_assignment(each)[1] for each in costs)
        if (chosen == other).all():
            compared += 1
            given = [torch.from_numpy(two[None]).float(), torch.ones(1, 180)]
            things = ThingSegments(segment[None].astype(np.int32), areas[:, 0].astype(int))
            np.testing.assert_array_equal(assigned_slots(*given, 0, things)[0], np.append(chosen, -1)[segment])
    assert compared > 50


def test_the_label_losses_are_cross_entropies() -> None:
    """Section "Loss Functions", L_sem without L_cluster, and L_ins, where each pixel is opaque and has a target."""
    random, pixels = np.random.default_rng(0), (6, 8)
    y, h = (random.dirichlet(np.ones(n), pixels) for n in (4, 5))
    target, assigned, matched = (random.integers(low, 4, pixels) for low in (0, -1, 0))
    semantic = instance = 0.0
    for at in np.ndindex(pixels):
        semantic -= np.log(y[at][target[at]]) / 48
        instance -= sum(np.log(h[at][each[at]]) for each in (assigned, matched) if each[at] >= 0) / 48
    targets = [torch.from_numpy(each.astype(np.int16)) for each in (target, assigned, matched)]
    coverage = torch.from_numpy(np.concatenate([y, h], 2)).float()
    found = label_losses(coverage, torch.ones(pixels), 4, targets[0], (targets[1], targets[2]))
    assert [loss.item() for loss in found] == pytest.approx([semantic, instance], rel=1e-5)


def test_label_losses_have_no_gradient_on_opacity(tmp_path: Path) -> None:
    """Section "Loss Functions": only the reconstruction loss does (one step, as the features differ later)."""
    views, classes = views_of(tmp_path)
    opacity = []
    for weight in (1000.0, 0.0):
        weights = replace(PAPER.weights, semantic=weight, instance=weight)
        paper = replace(PAPER, voxel_size=0.1, weights=weights)
        prepared = prepared_for(views, classes, paper, tmp_path)
        TinyTrainer(prepared.scene, prepared.targets, views, paper, 0).step()
        opacity.append([each.detach().clone() for each in prepared.scene.decoders.opacity.parameters()])
    assert all(torch.equal(*pair) for pair in zip(*opacity, strict=True))
