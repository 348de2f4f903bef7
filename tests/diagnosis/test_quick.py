"""What a lift asks of its scene before it begins: the cheap half of the diagnosis, and what it stops."""

import shutil
from pathlib import Path

import pytest

import engine.diagnosis.run as diagnosis_run
from engine.diagnosis import diagnose_quickly
from engine.job import EventWriter, LiftFolder, LiftRequest
from engine.job.report import metrics_text
from engine.lift import run
from engine.scene import open_scene
from tests.diagnosis.matrix import FAULTS
from tests.raises_key import raises_key
from tests.tiny_scene import write_tiny_scene
from tests.train.tiny_lift import warnings_in

STOPPED = (
    "world-to-camera poses", "OpenGL axes", "poses in centimetres", "depth in centimetres", "poses of the next frame",
    "intrinsics of half the size", "depth mirrored", "colour mirrored",
)  # fmt: skip
TOLD = ("y is up", "one frame repeated", "poses a tenth too far")


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny_scene(tmp_path_factory.mktemp("good") / "scene", 20, (96, 72))


def spoilt(good: Path, folder: Path, fault: str) -> Path:
    scene = Path(shutil.copytree(good, folder / "scene"))
    FAULTS[fault].plant(scene)
    return scene


def test_the_full_diagnosis_is_skipped_for_a_clean_scene(good: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(diagnosis_run, "diagnose", None)
    assert not diagnose_quickly(open_scene(good)).findings


@pytest.mark.parametrize("fault", [*STOPPED, *TOLD])
def test_the_quick_check_before_a_lift_finds_certain_faults(good: Path, tmp_path: Path, fault: str) -> None:
    found = diagnose_quickly(open_scene(spoilt(good, tmp_path, fault)))
    assert {each.cause for each in found.findings} & {*FAULTS[fault].causes}
    assert (found.stopping is not None) == (fault in STOPPED)


@pytest.mark.parametrize(("anyway", "resumed"), [(False, False), (True, False), (False, True)])
def test_a_faulty_scene_is_lifted_only_with_anyway(good: Path, tmp_path: Path, anyway: bool, resumed: bool) -> None:
    scene = spoilt(good, tmp_path, "world-to-camera poses")
    folder = LiftFolder.create(tmp_path / "lift", LiftRequest(scene=scene, anyway=anyway))
    events = EventWriter(folder.events_path)
    opened = open_scene(scene)
    if anyway or resumed:
        found = run.ask_what_is_wrong(folder, opened, (96, 72), events, stops=not resumed)
        text = metrics_text({"findings": [each.as_json() for each in found]})
        assert "Wrong with the scene: inverted poses" in text
    else:
        with raises_key("wrong-for-certain invert --anyway"):
            run.ask_what_is_wrong(folder, opened, (96, 72), events, stops=True)
    assert any("inverted poses" in each and "invert them" in each for each in warnings_in(folder.events_path))
    events.close()


def test_a_stopped_lift_is_resumed_with_the_option_anyway(tmp_path: Path) -> None:
    """A lift that was stopped, of a batch or with --resume, is not another lift for that."""
    plain = LiftRequest(scene=tmp_path)
    folder = LiftFolder.create(tmp_path / "lift", plain)
    asked = LiftRequest(scene=tmp_path, anyway=True)
    assert folder.asked_again(asked).request.anyway and LiftFolder.open(folder.path).request == asked
    assert LiftFolder.open(folder.path).asked_again(plain).request.anyway
    with raises_key("other-options"):
        folder.asked_again(LiftRequest(scene=tmp_path, seed=1, anyway=True))
