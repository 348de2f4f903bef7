"""Predicted time and memory: near what lifts took, and nearer once this machine is known."""

from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from engine.job.prediction import MB, learn_slowness, machine_slowness, predict, predict_bake, step_seconds
from engine.presets.preset import PRESETS

SAMPLE = {"train_frames": 63, "test_frames": 9, "frame_size": (320, 240)}


def test_better_presets_are_predicted_to_take_more_time_and_memory() -> None:
    least = predict(**SAMPLE, preset=PRESETS["preview"])  # type: ignore[arg-type]
    for name in ("standard", "paper"):
        more = predict(**SAMPLE, preset=PRESETS[name])  # type: ignore[arg-type]
        assert more.seconds > 2 * least.seconds and more.peak_bytes > least.peak_bytes
        least = more
    standard = PRESETS["standard"]
    base = predict(**SAMPLE, preset=standard)  # type: ignore[arg-type]
    for changed in (replace(standard, steps=3000), replace(standard, size=(640, 640))):
        assert predict(200, 20, (1280, 960), changed).seconds > base.seconds
    assert predict(**SAMPLE, preset=standard, bake="all").stages["bake"] > base.stages["bake"]  # type: ignore[arg-type]
    # Frames held out are rendered and scored even so.
    assert 0 < predict(**SAMPLE, preset=standard, bake="none").stages["bake"] < base.stages["bake"]  # type: ignore[arg-type]
    assert predict(**SAMPLE, preset=standard, slowness=2.0).seconds == pytest.approx(2 * base.seconds)  # type: ignore[arg-type]
    assert predict(1, 0, (64, 48), replace(standard, steps=1)).seconds > 0


def test_the_speed_of_the_machine_is_learnt_from_its_lifts(tmp_path: Path) -> None:
    assert machine_slowness(tmp_path) == 1.0
    usual = step_seconds(0.0768, 0.6)
    for factor in (2.0, 2.2, 9.0):
        learn_slowness(usual * factor, 0.0768, 0.6, tmp_path)
    assert machine_slowness(tmp_path) == pytest.approx(2.2)
    for _ in range(5):
        learn_slowness(usual * 0.5, 0.0768, 0.6, tmp_path)
    assert machine_slowness(tmp_path) == pytest.approx(0.5)


@pytest.mark.parametrize(
    "content",
    ["{", "[]", '{"format": 1}', '{"format": 1, "slowness": ["x", -1, 0, 1e99]}', "\0", "[" * 100_000],
    ids=range(6),
)
def test_a_broken_file_of_measured_speed_is_ignored(tmp_path: Path, content: str) -> None:
    (tmp_path / "speed.json").write_text(content)
    assert machine_slowness(tmp_path) == 1.0
    learn_slowness(0.8, 0.0768, 0.6, tmp_path)
    assert machine_slowness(tmp_path) != 1.0


@dataclass(frozen=True)
class Measured:
    """What a ``preview`` lift took on two busy cores: seconds, of which ``train``, and ``peak_mb``; frames trained and
    held out."""

    frames: tuple[int, int]
    size: tuple[int, int]
    masks: float
    seconds: float
    train: float
    peak_mb: float | None


LIFTS = (
    Measured((63, 9), (320, 240), 19, 250.0, 166.6, None),  # the sample
    Measured((92, 8), (1296, 968), 21, 322.7, 120.2, 2035),  # and long captures made of it: bench long
    Measured((292, 8), (1296, 968), 21, 1083.1, 443.5, 2012),
    Measured((1992, 8), (1296, 968), 21, 1588.4, 687.3, 2425),
    Measured((92, 8), (1296, 968), 21, 452.7, 201.3, 2244),  # in other hours
    Measured((1992, 8), (1296, 968), 21, 713.8, 392.6, 2419),
)


@pytest.mark.parametrize("lift", LIFTS, ids=lambda lift: f"{lift.frames[0]} in {lift.seconds:.0f} s")
def test_predictions_are_close_to_measured_lifts(lift: Measured) -> None:
    """Within a factor of 1.5, once it is known how fast the machine was, which the training steps tell."""
    about = {"bake": "none", "masks_a_frame": lift.masks, "classes": 18}
    usual = predict(*lift.frames, lift.size, PRESETS["preview"], **about)  # type: ignore[arg-type]
    slowness = lift.train / usual.stages["train"]
    predicted = predict(*lift.frames, lift.size, PRESETS["preview"], slowness=slowness, **about)  # type: ignore[arg-type]
    assert lift.seconds / 1.5 < predicted.seconds < 1.5 * lift.seconds
    assert lift.peak_mb is None or lift.peak_mb / 1.5 < predicted.peak_bytes / 1e6 < 1.5 * lift.peak_mb


def test_prediction_counts_unused_frames_at_most_for_reading_and_voting() -> None:
    voting = replace(PRESETS["preview"], frames=100)
    preset = replace(voting, all_frames_vote=False)
    size = (640, 480)
    few, many = predict(100, 10, size, preset), predict(5000, 10, size, preset)
    all_ = predict(5000, 10, size, replace(preset, frames=0))
    assert many.peak_bytes == few.peak_bytes < all_.peak_bytes
    assert few.seconds < many.seconds < 1.5 * few.seconds < all_.seconds
    with_votes = predict(5000, 10, size, voting)
    assert many.seconds < with_votes.seconds < 0.1 * all_.seconds and with_votes.peak_bytes == many.peak_bytes
    assert predict(100, 10, size, voting) == few, "where all are trained on nobody else votes"


def test_the_predicted_time_of_a_bake_grows_with_its_pixels() -> None:
    one, many = predict_bake(1, (1920, 1080)), predict_bake(2000, (1920, 1080), slowness=2.0)
    more = predict_bake(1, (1920, 1080), layers=("normal", "position"))
    assert 2.3 < more.bytes / one.bytes < 2.7, "docs/passes.md: 52 and 21 MB"
    assert 15 * MB < one.bytes < 25 * MB and many.bytes == pytest.approx(2000 * one.bytes)
    assert 2.0 < one.seconds < 30.0 and many.seconds == pytest.approx(4000 * one.seconds)
