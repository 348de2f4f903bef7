"""Live previews: what they show, what they cost, and that they change nothing."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from engine.errors import Cancelled
from engine.job import EventWriter, LiftFolder, LiftRequest, last_run
from engine.job.cameras import PreviewCamera, write_preview_request
from engine.lift import live_previews
from engine.lift.live_previews import LivePreviews, points_picture
from engine.scene import Camera, Category, ClassTable, distinct_colour, open_scene
from engine.semantics.point_cloud import SemanticPointCloud
from engine.train.trainer import Trainer
from tests.lift.test_lift import files_of
from tests.tiny_scene import ROOM, write_tiny_scene
from tests.train.tiny_lift import TINY, presets_as, run, trainer_of, views_of

FROM_ABOVE = PreviewCamera(
    ((1.0, 0.0, 0.0, 2.0), (0.0, -1.0, 0.0, 1.5), (0.0, 0.0, -1.0, 2.4), (0.0, 0.0, 0.0, 1.0)),
    ((600.0, 0.0, 600.0), (0.0, 600.0, 400.0), (0.0, 0.0, 1.0)),
    1200,
    800,
)


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    with presets_as(preview=TINY):
        yield write_tiny_scene(tmp_path_factory.mktemp("live") / "scene", frames=6, noise=0.1)


def told(folder: LiftFolder, kind: str) -> list[str]:
    events = last_run(folder.events_path)
    return [str(event.data.get("path", event.data.get("message"))) for event in events if event.kind == kind]


def test_live_previews_change_no_result(scene_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    unwatched = LiftFolder.create(tmp_path / "unwatched", LiftRequest(scene=scene_folder))
    with monkeypatch.context() as unseen:
        unseen.setattr(LivePreviews, "__call__", lambda *_: None)
        unseen.setattr(LivePreviews, "show_points", lambda *_: None)
        run(unwatched)
    assert "result/previews/live.png" not in told(unwatched, "preview")

    monkeypatch.setattr(live_previews, "EVERY_S", -1.0)
    monkeypatch.setattr(live_previews, "LARGEST_SHARE", 1.0)
    watched = LiftFolder.create(tmp_path / "watched", LiftRequest(scene=scene_folder))
    wanted = iter(["0001", "{", FROM_ABOVE, "no such frame", "0000", FROM_ABOVE] * 2)
    step, sizes, stopped = Trainer.step, [], []

    def step_and_turn(trainer: Trainer, *arguments: object) -> object:
        if watched.live_preview_path.exists():
            sizes.append(cv2.imread(str(watched.live_preview_path)).shape[:2])
        if trainer.step_number == 7 and not stopped:
            stopped.append(7)
            raise Cancelled("asked to")
        camera = next(wanted)
        if camera == "{":
            watched.preview_request_path.write_text(camera)
        else:
            write_preview_request(watched.preview_request_path, camera)
        return step(trainer, *arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(Trainer, "step", step_and_turn)
    with pytest.raises(Cancelled):
        run(watched)
    assert told(watched, "preview") == ["result/previews/live.png"] * 10, "two of points, one before the first step"
    kinds = [event.data.get("name", event.kind) for event in last_run(watched.events_path)]
    assert kinds.index("consistency") < kinds.index("preview") < kinds.index("match"), "as soon as there are labels"
    cameras = [event.data.get("camera") for event in last_run(watched.events_path) if event.kind == "preview"]
    assert cameras == [None] * 5 + [FROM_ABOVE.fingerprint, None, None, FROM_ABOVE.fingerprint, None]
    assert len(told(watched, "warning")) == len(told(unwatched, "warning")) + 1  # of two broken ones the first
    run(watched, resume=True)
    assert files_of(watched) == files_of(unwatched) and not watched.live_preview_path.exists()
    assert {(48, 64), (320, 480)} <= set(sizes)


def test_preview_points_show_their_labels_and_hide_points_behind() -> None:
    xyz, owner = (
        np.array([[0, 0, 1], [0, 0, 4], [0.5, 0, 1], [-0.5, 0, 1]], np.float32),
        np.array([0, 9, 7, 0], np.int32),
    )
    no_votes = np.zeros((4, 2), np.float32)
    grey = np.full((4, 3), 100, np.uint8)
    cloud = SemanticPointCloud(xyz, grey, np.array([1, 2, 2, 0], np.int32), no_votes[:, 0], no_votes, (1, 2), 0.05)
    classes = ClassTable((Category(1, "wall", False, (200, 0, 0)), Category(2, "chair", True, (0, 200, 0))))
    camera = Camera(64, 48, 50.0, 50.0, 32.0, 24.0, np.eye(4))
    picture, shown = points_picture(cloud, owner, np.array([True, True, True, False]), camera, classes)
    red, green, blue = picture[24, 32].astype(int)
    assert red > green == blue > 0, "the near point of the wall"
    tint = picture[24, 57].astype(float) - 0.45 * 100
    assert np.corrcoef(tint, distinct_colour(7))[0, 1] > 0.99, "the chair's own colour"
    assert not shown[24, 7] and not picture[0, 0].any() and shown.sum() < 100


def test_live_previews_take_a_twentieth_of_the_training_time(
    scene_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trainer = trainer_of(*views_of(tmp_path / "scene"), TINY, tmp_path)
    scene = open_scene(scene_folder, None, up="z")
    folder = LiftFolder.create(tmp_path / "lift", LiftRequest(scene=scene_folder))
    for cost, expected in ((0.02, 2.0), (0.5, 9.5), (3.0, 12.0)):
        now, drawn = [0.0], []
        previews = LivePreviews(folder, scene, EventWriter(tmp_path / "e"), clock=lambda: now[0])  # noqa: B023

        def draw(_: object, now: list[float] = now, drawn: list[float] = drawn, cost: float = cost) -> None:
            now[0] += cost if drawn else 40.0  # the first one compiles
            drawn.append(now[0])

        monkeypatch.setattr(previews, "_draw", draw)
        while now[0] < 300:
            now[0] += 0.1
            previews(trainer.scene)
        assert drawn[0] == pytest.approx(40.1) and drawn[1] < 40.1 + 2.3 + cost
        gaps = np.diff(drawn[1:]) - cost
        assert gaps.min() >= expected - 1e-9 and gaps.max() < expected + 0.2
        assert cost > 1 or cost * len(drawn[1:]) <= 0.05 * now[0] + cost


def test_a_live_preview_from_outside_shows_the_inside_of_the_room(scene_folder: Path, tmp_path: Path) -> None:
    """As the cloud and the result are in Blender, over which the picture is drawn."""
    trainer = trainer_of(*views_of(tmp_path / "scene"), TINY, tmp_path)
    scene = open_scene(scene_folder, None, up="z")
    folder = LiftFolder.create(tmp_path / "lift", LiftRequest(scene=scene_folder))
    xyz = trainer.scene.anchors.position.numpy(force=True)
    at = np.random.default_rng(0).uniform(ROOM[0], ROOM[1], (6, 4000, 3))
    for face in range(6):
        at[face, :, face % 3] = ROOM[face // 3, face % 3]
    walls = at.reshape(-1, 3).astype(np.float32)
    previews = LivePreviews(folder, scene, EventWriter(tmp_path / "e"), surface=walls)
    drawn = {}
    for name, eye in (("inside", scene.frames[0].camera.centre), ("outside", np.array([2.0, -6.0, 1.2]))):
        pose = ((1.0, 0.0, 0.0, eye[0]), (0.0, 0.0, 1.0, eye[1]), (0.0, -1.0, 0.0, eye[2]), (0.0, 0.0, 0.0, 1.0))
        write_preview_request(folder.preview_request_path, PreviewCamera(pose, FROM_ABOVE.K, 1200, 800))
        previews._due = 0.0
        previews(trainer.scene)
        picture = cv2.imread(str(folder.live_preview_path), cv2.IMREAD_UNCHANGED)
        assert picture.shape == (320, 480, 4)
        drawn[name] = previews._without_backs(trainer.scene, eye).anchors.position.numpy(force=True), picture[..., 3]
    assert len(drawn["inside"][0]) == len(xyz) > len(drawn["outside"][0]) > 0
    wall = xyz[:, 1].min() + 0.1
    near = [np.count_nonzero((points[:, 1] < wall) & (points[:, 2] > 0.3)) for points, _ in drawn.values()]
    assert near[1] < 0.3 * near[0], "the wall between the eye and the room is left out"
    assert drawn["outside"][1].min() == 0 and drawn["outside"][1].max() == 255
