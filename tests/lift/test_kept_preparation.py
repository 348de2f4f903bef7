"""A resumed lift takes what was found before its first step from its folder, and finds it again where it must."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from engine.errors import Cancelled, PlgsError
from engine.job import EventWriter, LiftFolder, LiftRequest, StopSignal, last_run, verify
from engine.job.report import not_shown, read_metrics
from engine.lift import run
from engine.lift.kept_preparation import KeptPreparation
from engine.lift.objects import Matching
from engine.lift.repairs import Labelled
from engine.lift.targets_of_views import Photos
from engine.metrics.unshown import Refused, Unshown
from engine.presets.preset import Preset
from engine.scene import open_asked
from engine.scene_of_lift import remember_scene
from engine.semantics.point_cloud import SemanticPointCloud
from engine.train.trainer import Trainer
from tests.tiny_scene import CHAIR_ID, write_tiny_scene
from tests.train.tiny_lift import short_warm_start

STEPS = 3
REPEATED = {"consistency", "match"}


def lift(folder: LiftFolder, *, resume: bool, stop_at: int | None = None) -> list[str]:
    """Lift until a step, or to the end; the stages of this run."""

    class Stopped(Trainer):
        def step(self, check: Callable[[], object] = lambda: None):  # type: ignore[no-untyped-def]
            if self.step_number == stop_at:
                raise Cancelled("here")
            return super().step(check)

    def training(prepared: run.PreparedLift, views: object, preset: Preset, seed: int) -> Trainer:
        return Stopped(prepared.scene, prepared.targets, views, preset, seed)  # type: ignore[arg-type]

    events = EventWriter(folder.events_path)
    events.hello(threads=1, resumed=resume)
    try:
        with short_warm_start():
            run.run_lift(folder, events, StopSignal(folder.cancel_path), resume=resume, training=training)
    except Cancelled:
        pass
    finally:
        events.close()
    return [event.data["name"] for event in last_run(folder.events_path) if event.kind == "stage"]


def repaired_but_for_one(given: Labelled, *_: object, **__: object) -> Labelled:
    """Instead of the trials: one is refused, of a chair on the wall."""
    chair = Unshown(CHAIR_ID, "chair", False, 3, 3, "0", 1, 100, (0.1 + 0.2) / 8, "", (4.0, 0.1, 0.2))
    return replace(given, refused=(Refused(replace(chair, refused="by itself"), ((4.0, 1.0 + 1 / 3, 1.2),)),))


@pytest.mark.parametrize("objects", ["agreement", "boxes"])
def test_what_was_found_is_not_found_again(objects: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = write_tiny_scene(tmp_path / "scene", frames=5, size=(32, 24))
    request = LiftRequest(scene=scene, options={"steps": STEPS, "objects": objects, "fill_holes": True})
    monkeypatch.setattr("engine.lift.objects.repaired", repaired_but_for_one)
    calm, rough = (LiftFolder.create(tmp_path / name, request) for name in ("calm", "rough"))
    assert lift(calm, resume=False) == list(run.STAGES)
    assert REPEATED < {*lift(rough, resume=False, stop_at=1)}
    monkeypatch.setattr("engine.lift.starting_scene.warm_start", None)  # the checkpoint has what it would fit
    assert lift(rough, resume=True) == [name for name in run.STAGES if name not in REPEATED]
    assert verify(rough.result_path).files == verify(calm.result_path).files
    told = [text for text, _ in not_shown(read_metrics(rough)) if "refused" in text]
    trial = "one chair: 3 near views; tried before training, refused: by itself"
    assert told == ([trial] if objects == "agreement" else [])


def test_the_labels_of_all_views_are_kept(tmp_path: Path) -> None:
    """Of those of more than 64 views, 64 were read back, and a resumed lift ended with an IndexError."""
    folder = LiftFolder.create(tmp_path / "lift", LiftRequest(scene=tmp_path))
    cloud = SemanticPointCloud(
        np.zeros((1, 3), np.float32), np.zeros((1, 3), np.uint8), np.ones(1, np.int32), np.ones(1, np.float32),
        np.ones((1, 1), np.float32), (1,), 0.05,
    )  # fmt: skip
    maps = [np.full((2, 3), number, np.int16) for number in range(70)]
    kept = KeptPreparation(folder, True, None, "code")
    kept.write([], 0, Matching(cloud, [], np.zeros(1, np.int32), 0, maps), Photos(np.ones(70), None))
    found = kept.read([], 0)
    assert found is not None and found[0].label_maps is not None
    assert [int(labels[0, 0]) for labels in found[0].label_maps] == list(range(70))


def test_what_does_not_fit_is_found_again(tmp_path: Path) -> None:
    """After damage to a file, and after a change of the masks. A lift whose frame has moved does not go on."""
    scene = write_tiny_scene(tmp_path / "scene", frames=5, size=(32, 24))
    folder = LiftFolder.create(tmp_path / "lift", LiftRequest(scene=scene, options={"steps": STEPS}))
    lift(folder, resume=False, stop_at=1)
    arrays = folder.path / "preparation" / "arrays.npz"
    arrays.write_bytes(arrays.read_bytes()[:-9])
    assert REPEATED < {*lift(folder, resume=True, stop_at=1)}
    assert not REPEATED & {*lift(folder, resume=True, stop_at=1)}, "it was kept again"
    picture = min((scene / "panoptic").glob("*.png"))
    content = cv2.imread(str(picture), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(picture), np.where(content == content.max(), content.min(), content))
    remember_scene(folder, open_asked(folder.request))  # as by a run that was killed before it found anything
    assert REPEATED < {*lift(folder, resume=True, stop_at=1)}
    pose = min((scene / "pose").glob("*.txt"))
    moved = np.loadtxt(pose)
    moved[0, 3] += 0.1
    np.savetxt(pose, moved)
    with pytest.raises(PlgsError, match="the camera of 0000 differs"):
        lift(folder, resume=True, stop_at=1)


def test_a_run_that_was_killed_does_not_hide_that_the_masks_have_changed(tmp_path: Path) -> None:
    """It had noted the new masks, and what was learnt of the old ones was taken for theirs."""
    scene = write_tiny_scene(tmp_path / "scene", frames=5, size=(32, 24))
    options = {"steps": STEPS, "labels": "decoders"}
    folder = LiftFolder.create(tmp_path / "lift", LiftRequest(scene=scene, options=options))
    lift(folder, resume=False, stop_at=2)
    for picture in (scene / "panoptic").glob("*.png"):
        mask = cv2.imread(str(picture))
        mask[:, :10] = 0
        cv2.imwrite(str(picture), mask)
    remember_scene(folder, open_asked(folder.request))
    lift(folder, resume=True, stop_at=2)
    told = [event.data["message"] for event in last_run(folder.events_path) if event.kind == "warning"]
    assert any("trained again" in str(line) for line in told)
