"""The training loop: its warm start, what it learns and keeps apart, and that a restored one goes on bit for bit."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from engine.errors import Cancelled
from engine.model.structured import NO_OBJECT, SPARE, LabelChannels, StructuredScene
from engine.presets.preset import LossWeights
from engine.scene import Camera, ClassTable, View
from engine.train import warm_start
from engine.train.state import restore, trainer_state
from engine.train.targets import view_targets
from engine.train.trainer import Trainer, reconstruction_loss
from tests.model.some_scene import mean_depth
from tests.semantics.plane_views import CHAIR, CLASS_IDS, WALL, square, wall_view
from tests.train.tiny_lift import STEPS, TINY, WARM_STEPS, colour_error, prepared_for, trainer_of, views_of

Input = tuple[list[View], ClassTable]


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Input:
    return views_of(tmp_path_factory.mktemp("tiny") / "scene")


def whole_state(trainer: Trainer) -> tuple[dict[str, torch.Tensor], dict[str, object]]:
    tensors, facts = trainer_state(trainer)
    return {name: tensor.clone() for name, tensor in tensors.items()}, facts


def assert_equal(one: dict[str, torch.Tensor], two: dict[str, torch.Tensor]) -> None:
    assert one.keys() == two.keys()
    different = [name for name in one if not torch.equal(one[name], two[name])]
    assert not different


def test_a_restored_trainer_continues_bit_for_bit(tiny: Input, tmp_path: Path) -> None:
    whole = trainer_of(*tiny, TINY, tmp_path)
    started_with = len(whole.scene.anchors)
    stored = {0: whole_state(whole)}
    losses = []
    while not whole.finished:
        losses.append(whole.step().loss)
        stored[whole.step_number] = whole_state(whole)
    assert len(whole.scene.anchors) > started_with
    assert all(labels is not None and labels.slots is not None for labels in whole.pseudo)

    # Before the first step, before any growth, between growth and pseudo labels, and after both.
    for step in (0, 2, 3, 9):
        resumed = trainer_of(*tiny, TINY, tmp_path)
        restore(resumed, *stored[step])
        assert_equal(trainer_state(resumed)[0], stored[step][0])
        assert [resumed.step().loss for _ in range(step, STEPS)] == losses[step:]
        tensors, facts = trainer_state(resumed)
        assert_equal(tensors, stored[STEPS][0])
        assert facts == stored[STEPS][1] and resumed.finished


def test_training_lowers_the_picture_loss(tiny: Input, tmp_path: Path) -> None:
    trainer = trainer_of(*tiny, replace(TINY, steps=40), tmp_path)
    before = colour_error(tiny[0], trainer)
    losses = []
    while not trainer.finished:
        losses.append(trainer.step().reconstruction)
    epoch = len(tiny[0])
    assert sum(losses[-epoch:]) < 0.8 * sum(losses[:epoch])
    assert colour_error(tiny[0], trainer) < 0.7 * before


def test_label_losses_have_no_gradient_on_opacity_or_shape(tiny: Input, tmp_path: Path) -> None:
    trainer = trainer_of(*tiny, TINY, tmp_path)
    target = trainer.targets[0]
    gaussians = trainer._decode(target)
    assert gaussians.cluster_loss > 0
    columns = trainer._columns_to_draw(target)
    rendering = gaussians.drawn_by(target.camera, gaussians.labels[:, columns], want_means2d_grad=True)
    semantic, instance = trainer._compare_labels(gaussians, rendering, target, columns)
    assert semantic > 0 and instance > 0
    (semantic + gaussians.cluster_loss + instance).backward()

    decoders, anchors = trainer.scene.decoders, trainer.scene.anchors
    for untouched in (decoders.opacity, decoders.covariance, decoders.colour):
        assert all(p.grad is None or not p.grad.any() for p in untouched.parameters())
    assert all(each is None or not each.any() for each in (anchors.offset.grad, anchors.log_scale.grad))
    for taught in (decoders.semantic, decoders.instance):
        assert all(p.grad is not None and p.grad.any() for p in taught.parameters())


def test_labels_without_targets_are_not_drawn(tiny: Input, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The model is the same, bit for bit, after steps that draw all of them."""
    few = trainer_of(*tiny, TINY, tmp_path)
    drawn = few._columns_to_draw(few.target(0))
    channels = few.scene.channels
    everything = torch.arange(len(channels.class_ids) + len(channels.slot_ids))
    assert 0 < len(drawn) < len(everything)
    all_ = trainer_of(*tiny, TINY, tmp_path)
    monkeypatch.setattr(all_, "_columns_to_draw", lambda target: everything)
    for _ in range(5):
        one, two = few.step(), all_.step()
        assert one.semantic == two.semantic and one.instance == two.instance
    assert_equal(whole_state(few)[0], whole_state(all_)[0])


def test_pseudo_labels_stopped_halfway_are_started_again(tiny: Input, tmp_path: Path) -> None:
    whole, stopped = (trainer_of(*tiny, TINY, tmp_path) for _ in range(2))
    for trainer in (whole, stopped):
        for _ in range(4):
            trainer.step()
    before = whole_state(stopped)

    calls = 0

    def stop_at_the_third_view() -> None:
        nonlocal calls
        calls += 1
        if calls == 3:
            raise Cancelled("asked to")

    with pytest.raises(Cancelled):
        stopped.step(stop_at_the_third_view)
    assert_equal(trainer_state(stopped)[0], before[0])
    assert whole.step() == stopped.step()
    assert_equal(trainer_state(stopped)[0], trainer_state(whole)[0])


def far_away(camera: Camera) -> np.ndarray:
    """The camera's pose a kilometre off."""
    pose = camera.camera_to_world.copy()
    pose[:3, 3] += 1000.0
    return pose


def test_pseudo_labels_ignore_pixels_that_are_not_rendered(tiny: Input, tmp_path: Path) -> None:
    trainer = trainer_of(*tiny, TINY, tmp_path)
    first, *others = trainer.views
    trainer.views = [replace(first, camera=replace(first.camera, camera_to_world=far_away(first.camera))), *others]
    trainer.refresh_pseudo_labels()
    nothing, something = trainer.target(0).pseudo, trainer.target(1).pseudo
    assert nothing is not None and (nothing == -1).all()
    assert something is not None and (something >= 0).any()


def test_pseudo_labels_give_each_segment_a_class_and_an_object(tiny: Input, tmp_path: Path) -> None:
    trainer = trainer_of(*tiny, TINY, tmp_path)
    trainer.refresh_pseudo_labels()
    channels = trainer.scene.channels
    owned = 0
    for target in map(trainer.target, range(len(trainer.views))):
        classes, slots = target.semantic, target.slot
        assert target.pseudo is not None and target.pseudo_slot is not None
        known = classes >= 0
        assert torch.equal(slots >= 0, known), "what has a class has an object, or none for certain"
        for slot in slots.unique().tolist():
            own = classes[slots == slot]
            if slot in channels.instance_slots:
                owned += len(own)
                assert (own == channels.class_ids.index(channels.class_of_slot[slot])).all()
            else:
                assert slot == channels.slot_ids.index(NO_OBJECT) or (slot == -1 and (own == -1).all())
    assert owned > 0
    plain = trainer_of(*tiny, replace(TINY, one_class_an_object=False), tmp_path)
    plain.refresh_pseudo_labels()
    assert all(labels is not None and labels.slots is None for labels in plain.pseudo)


def test_pixels_of_black_borders_have_no_gradient(tiny: Input, tmp_path: Path) -> None:
    trainer = trainer_of(*tiny, TINY, tmp_path)
    target = trainer.targets[0]
    image = torch.rand(target.photo.values.shape, requires_grad=True)
    border = torch.zeros(image.shape[:2], dtype=torch.bool)
    border[:4] = True
    target.border = border
    picture = trainer._as_photographed(image, target)
    reconstruction_loss(
        picture, target.photo, torch.zeros(0, 3), photo_weight=1.0, ssim_weight=0.2, volume_weight=0.0
    ).backward()
    assert image.grad is not None and not image.grad[border].any() and image.grad[~border].abs().min() > 0


def test_colours_are_learnt_from_photos_of_different_exposure(tiny: Input, tmp_path: Path) -> None:
    """Up to what all photos have in common, which nobody can tell from the room's own light."""
    views, classes = tiny
    gains = np.geomspace(0.25, 1.0, len(views))[np.random.default_rng(2).permutation(len(views))]
    photos = [
        replace(view, colour=np.round(gain * view.colour).astype(np.uint8))
        for view, gain in zip(views, gains, strict=True)
    ]
    common = float(np.exp(np.log(gains).mean()))
    room = [replace(view, colour=np.round(common * view.colour).astype(np.uint8)) for view in views]
    errors = {}
    for fit in (True, False):
        trainer = trainer_of(photos, classes, replace(TINY, steps=42, fit_exposure=fit), tmp_path)
        while not trainer.finished:
            trainer.step()
        errors[fit] = colour_error(room, trainer)
        if fit:
            found = np.array([target.gain.mean() for target in trainer.targets if target.gain is not None])
            np.testing.assert_allclose(found, gains / common, rtol=0.1)
        else:
            assert all(target.gain is None for target in trainer.targets)
    assert errors[True] < 0.85 * errors[False]


def test_training_fits_depth_to_the_sensors(tiny: Input, tmp_path: Path) -> None:
    views, classes = tiny
    errors = {}
    for weight in (0.0, 0.5):
        trainer = trainer_of(views, classes, replace(TINY, steps=42, weights=LossWeights(depth=weight)), tmp_path)
        while not trainer.finished:
            trainer.step()
        drawn = [mean_depth(trainer.scene, view.camera) for view in views]  # what the loss fits, not the surface's
        errors[weight] = np.median([np.abs(one - view.depth) for one, view in zip(drawn, views, strict=True)])
    assert errors[0.5] < 0.8 * errors[0.0]


def test_a_view_that_sees_nothing_does_not_break_training(tiny: Input, tmp_path: Path) -> None:
    trainer = trainer_of(*tiny, TINY, tmp_path)
    trainer.targets = [
        replace(target, camera=replace(target.camera, camera_to_world=far_away(target.camera)))
        for target in trainer.targets
    ]
    before = whole_state(trainer)[0]
    assert trainer.step().gaussians == 0
    after = trainer_state(trainer)[0]
    assert all(torch.equal(after[name], before[name]) for name in before if name.startswith("model."))


def test_a_diverged_training_takes_no_further_steps(tiny: Input, tmp_path: Path) -> None:
    trainer = trainer_of(*tiny, TINY, tmp_path)
    with torch.no_grad():
        trainer.scene.anchors.log_scale[0] = 90.0
    before = whole_state(trainer)[0]
    with pytest.raises(FloatingPointError, match="step 1 "):
        trainer.step()
    assert_equal(trainer_state(trainer)[0], before)


def test_training_never_exceeds_the_limit_on_anchors(tiny: Input, tmp_path: Path) -> None:
    trainer = trainer_of(*tiny, TINY, tmp_path)
    most = len(trainer.scene.anchors) + 5
    trainer = trainer_of(*tiny, replace(TINY, most_anchors=most), tmp_path)
    while not trainer.finished:
        trainer.step()
        assert len(trainer.scene.anchors) <= most


def test_a_finished_training_keeps_no_moments_and_can_be_restored(tiny: Input, tmp_path: Path) -> None:
    """A finished lift is resumed when its masks change."""
    preset = replace(TINY, steps=3)
    trainer, other = (trainer_of(*tiny, preset, tmp_path) for _ in range(2))
    trainer.step()
    assert any(name.startswith("optimiser.") for name in trainer_state(trainer)[0])
    while not trainer.finished:
        trainer.step()
    tensors, facts = trainer_state(trainer)
    assert not any(name.startswith("optimiser.") for name in tensors)
    restore(other, tensors, facts)
    assert other.finished
    assert_equal(trainer_state(other)[0], tensors)


def test_a_stored_training_state_that_does_not_fit_is_refused(tiny: Input, tmp_path: Path) -> None:
    views, classes = tiny
    trainer = trainer_of(views, classes, TINY, tmp_path)
    trainer.step()
    tensors, facts = trainer_state(trainer)
    tensors = {name: tensor.detach().clone() for name, tensor in tensors.items()}
    count = len(trainer.scene.anchors)
    spoilt = {
        "model.anchors.position": torch.full((count, 3), torch.nan),
        "model.anchors.log_scale": torch.zeros(1, 6),
        "optimiser.anchors.feature.mean": torch.zeros(1, 3),
        "optimiser.anchors.offset.square": -torch.ones(count, TINY.gaussians_per_anchor, 3),
        "growth.visits": torch.zeros(count + 1),
        "pseudo.0": torch.full(views[0].depth.shape, 99, dtype=torch.int16),
        "pseudo_slot.0": torch.zeros(2, 2, dtype=torch.int16),
        "pseudo.999": torch.zeros(2, 2, dtype=torch.int16),
        "pseudo.x": torch.zeros(2, 2, dtype=torch.int16),
    }
    for name, tensor in spoilt.items():
        with pytest.raises((ValueError, KeyError)):
            restore(trainer, tensors | {name: tensor}, facts)
    for step in (-1, TINY.steps + 1, 1.5, None):
        with pytest.raises(ValueError, match="its step"):
            restore(trainer, tensors, facts | {"step": step})
    with pytest.raises(ValueError, match="other labels"):
        other = facts["model"] | {"slot_ids": [slot + (slot > 0) for slot in facts["model"]["slot_ids"]]}
        restore(trainer, tensors, facts | {"model": other})
    restore(trainer, tensors, facts)
    trainer.step()


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> list[StructuredScene]:
    """Warm, and cold; then warm in few steps from seeds 0, 0 and 1."""
    folder = tmp_path_factory.mktemp("warm")
    views, classes = views_of(folder / "scene")
    cold = replace(TINY, warm_start=False)
    chosen = ((TINY, 0, warm_start.STEPS), (cold, 0, 0), *((TINY, seed, WARM_STEPS) for seed in (0, 0, 1)))
    return [prepared_for(views, classes, each, folder, seed, warm_steps=steps).scene for each, seed, steps in chosen]


def share_right(scene: StructuredScene) -> float:
    """Share of the anchors with a known class whose every Gaussian shows that class first."""
    with torch.no_grad():
        logits, _ = scene.decoders.label_logits(scene.anchors.feature, scene.anchors.feature)
    class_ids = torch.tensor(scene.channels.class_ids)
    known = scene.anchors.initial_class > 0
    shown = class_ids[logits.argmax(dim=2)]
    return float((shown == scene.anchors.initial_class[:, None]).all(dim=1)[known].float().mean())


def test_the_warm_start_teaches_decoders_the_anchors_classes(scenes: list[StructuredScene]) -> None:
    assert share_right(scenes[0]) > 0.97
    assert share_right(scenes[1]) < 0.5


def test_the_warm_start_gives_the_same_decoders_for_the_same_seed(scenes: list[StructuredScene]) -> None:
    first, again, other = (scene.decoders.state_dict() for scene in scenes[2:])
    assert all(torch.equal(first[name], again[name]) for name in first)
    assert not all(torch.equal(first[name], other[name]) for name in first)


CHANNELS = LabelChannels(CLASS_IDS, (7, SPARE, NO_OBJECT, 3))


def test_stuff_is_trained_as_no_object() -> None:
    view = wall_view("a", 0.0, classes=square(CHAIR, WALL, slice(10, 20)).astype(np.int32))
    projected, matched = view.mask.ids.copy(), np.where(view.mask.ids == CHAIR, 7, 0).astype(np.int32)
    projected[:2] = 0
    border = np.zeros(view.mask.ids.shape, bool)
    border[0] = True
    target = view_targets(
        replace(view, border=border), CHANNELS, projected_class=projected, matched_instance=matched, weight=0.25
    )
    assert (target.slot[:2] == -1).all() and (target.semantic[:2] == -1).all()
    expected = square(CHANNELS.slot_ids.index(7), CHANNELS.slot_ids.index(NO_OBJECT), slice(10, 20))
    np.testing.assert_array_equal(target.slot[2:], expected[2:])
    assert target.weight == 0.25 and target.border is not None and torch.equal(target.border, torch.from_numpy(border))
    np.testing.assert_array_equal(target.depth, np.where(border, 0, view.depth))  # a border shows nothing
    target.pseudo, target.pseudo_slot = torch.zeros_like(target.projected), torch.ones_like(target.matched)
    assert target.semantic is target.pseudo and target.slot is target.pseudo_slot
