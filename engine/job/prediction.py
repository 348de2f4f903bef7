"""Predict how long a lift will take and how much memory it needs, before it is begun. The constants were measured on
lifts of the bundled sample (72 frames of 320x240) and of long captures made from it (100 to 2000 frames of 1296x968) on
two cores, relative to a training step. Finished lifts tell how much slower or faster this machine is. How much surface
the cameras see is unknown in advance: the sample's is assumed."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import NamedTuple

from ..errors import PlgsError
from ..presets.preset import Preset
from ..records import read_record, record_text
from .atomic import write_atomically
from .environment import notes_folder
from .lock import FileLock

SURFACE = 400.0
"""Square metres of surface that the sample's frames see, on which anchors lie."""
MOST_ANCHORS_PER_POINT = 0.8
USUAL_MASKS, USUAL_CLASSES = 20.0, 20
"""The segments of a frame and the classes of a scene that was not read."""
OBJECTS_A_MASK = 2.0
"""The number of objects in a room for each segment of a frame."""
MOST_MASKS = 5000
"""About this many masks, those of keyframes, are compared with one another; the others only join what was found."""
CANDIDATES = 3
"""The number of pictures that are examined for each chosen one."""
SEEN_SHARE = 0.3
"""The share of the Gaussians that one view sees."""
MASK_S = 5.0
"""Seconds in which a network makes the mask of a frame."""
WRITE_S = 2.0
"""Seconds to write the passes and previews of a megapixel."""
PIXEL = 12.0
"""Bytes per pixel in a file of passes: up to 12 at 1920x1080, 14 at 320x240."""
REMEMBERED = 5  # maximum number of remembered lifts; their median is used
MB = 1_000_000


_MORE = {"normal": 0.34, "position": 1.15, "vector": 1.5}
"""Bytes of each further layer relative to those of all usual layers together (docs/passes.md)."""


@dataclass(frozen=True)
class Prediction:
    """The predicted cost of a lift. ``stages`` are seconds by stage, in order, with "start" and "prepare" (before
    training); ``peak_bytes`` is the most main memory that the engine holds at once."""

    stages: Mapping[str, float]
    peak_bytes: int

    @property
    def seconds(self) -> float:
        return sum(self.stages.values())


@dataclass(frozen=True)
class _Speed:
    """The content of speed.json: how many times slower this machine was, in each recent lift, than the one where the
    constants were measured."""

    slowness: tuple[float, ...] = field(metadata={"least": 0.001, "most": 1000})


class BakeCost(NamedTuple):
    """The predicted cost of baking, in seconds and in bytes on disk."""

    seconds: float
    bytes: float


def predict_bake(frames: int, size: tuple[int, int], slowness: float = 1.0, layers: Collection[str] = ()) -> BakeCost:
    """Predict the cost of baking ``frames`` of ``size`` (width, height) with these FURTHER_LAYERS, as in `predict`."""
    megapixels = size[0] * size[1] / 1e6
    pixel = PIXEL * (1.0 + sum(_MORE[layer] for layer in layers))
    seconds = slowness * frames * (_render_s(megapixels) + WRITE_S * megapixels)
    return BakeCost(seconds, frames * megapixels * pixel * MB)


def _render_s(megapixels: float) -> float:
    return 0.2 + 3.0 * megapixels


def predict(
    train_frames: int,
    test_frames: int,
    frame_size: tuple[int, int],
    preset: Preset,
    *,
    bake: str = "test",
    slowness: float = 1.0,
    masks_a_frame: float = USUAL_MASKS,
    classes: int = USUAL_CLASSES,
) -> Prediction:
    """Predict a lift of ``train_frames`` + ``test_frames`` pictures of ``frame_size`` (width, height) pixels. ``bake``
    says which frames are baked ("test", "all", "none"); this machine is ``slowness`` times slower than usual."""
    frames = train_frames + test_frames
    views = preset.views_of(train_frames)
    own = frame_size[0] * frame_size[1] / 1e6
    trained_on = _megapixels_within(frame_size, preset.size)
    seen = views * trained_on
    rendered = {"test": test_frames, "all": frames, "none": test_frames}[bake]  # held-out frames are scored in any case
    written = 0 if bake == "none" else rendered
    scored = own if written else _megapixels_within(frame_size, preset.scored)
    steps = preset.for_views(views).last_step
    most = min(preset.most_anchors, MOST_ANCHORS_PER_POINT * preset.most_points)
    gaussians = preset.gaussians_per_anchor * min(SURFACE / preset.voxel_size**2, most) / 1e6  # in millions
    step = step_seconds(trained_on, gaussians)
    rounds = max(0, min(round(1 / preset.schedule.self_training_every), steps) - 1)
    voting = views if preset.shows_votes else 0
    voted = voting * _megapixels_within(frame_size, preset.vote_size)
    judged = min(views * masks_a_frame, MOST_MASKS) / 1000
    looked_at = min(train_frames, CANDIDATES * views) if views < train_frames else 0
    voters = train_frames - views if preset.all_frames_vote else 0
    stages = {
        "start": 4.0,
        "check": 0.1 + 0.03 * (views + test_frames) * own + 0.03 * looked_at * own,
        "read": 0.05 * views * own + 0.015 * voters * own,
        "consistency": 3.0 + 2.8 * seen,
        "match": 1.5
        + 1.0 * seen
        + 0.3 * judged**2  # each with each other one
        + 0.0005 * views * masks_a_frame
        + voters * (0.012 + 0.35 * trained_on),
        "prepare": 10.0 + 0.7 * seen,
        "train": steps * step + rounds * views * 0.42 * step,
        "result": 0.5 + 3.0 * voted + 0.12 * voting * own + 2.75 * gaussians,
        "evaluate": 0.5 + 1.6 * test_frames * scored,
        "bake": rendered * _render_s(scored) + written * WRITE_S * own,
    }
    labels = classes + OBJECTS_A_MASK * masks_a_frame
    peak = _peak_bytes(frame_size, preset, views, gaussians, labels=labels, classes=classes)
    return Prediction({name: slowness * seconds for name, seconds in stages.items()}, peak)


def mesh_bytes(views: int, size: tuple[int, int]) -> int:
    """Return the peak memory, in bytes, of an export of meshes: the libraries, the model and the surface, and 16 bytes
    for each pixel of its ``views`` of ``size`` (width, height). The voxels add little, as they are made in slabs."""
    return 1_460 * MB + 16 * views * size[0] * size[1]


def step_seconds(megapixels: float, millions_of_gaussians: float) -> float:
    """Return the seconds of a training step with pictures of this size and this number of Gaussians, on the machine
    where the constants were measured."""
    return 0.03 + 0.55 * megapixels + 0.3625 * millions_of_gaussians


def machine_slowness(cache: Path | None = None) -> float:
    """Return how many times slower this machine is than the measured one, by recent lifts; 1 without. Never raises."""
    measured = _measured(_speed_path(cache))
    return median(measured) if measured else 1.0


def learn_slowness(seconds: float, megapixels: float, millions_of_gaussians: float, cache: Path | None = None) -> None:
    """Remember that a training step of a finished lift, with so many pixels and Gaussians, took ``seconds``, in
    ``cache`` (None: the user's). Raises OSError, PlgsError if the file is locked."""
    path = _speed_path(cache)
    path.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(path.with_suffix(".lock"), wait_s=20.0):  # as for the list of recent lifts
        measured = [*_measured(path), seconds / step_seconds(megapixels, millions_of_gaussians)]
        write_atomically(path, record_text(_Speed(tuple(measured[-REMEMBERED:]))))


def _peak_bytes(
    frame_size: tuple[int, int], preset: Preset, views: int, gaussians: float, *, labels: float, classes: int
) -> int:
    """Return the peak memory of a lift in bytes. Matching needs more with the views and the points' votes, training
    with the Gaussians and labels, and baking with the labels and the pixels of a full-size frame."""
    own = frame_size[0] * frame_size[1] / 1e6
    trained_on = _megapixels_within(frame_size, preset.size)
    votes = 0.0
    if preset.objects not in ("boxes", "none"):
        votes = 16 * classes * preset.most_points / 1e6  # float64, and a copy
    matching = 800 + 12 * views * trained_on + votes
    training = 880 + 500 * gaussians + (700 + 8 * labels) * trained_on + SEEN_SHARE * gaussians * 12 * labels
    baking = 700 + 400 * gaussians + (1000 + 4 * labels) * own
    return round(max(matching, training, baking) * MB)


def _megapixels_within(size: tuple[int, int], box: tuple[int, int]) -> float:
    scale = min(1.0, box[0] / size[0], box[1] / size[1])
    return size[0] * size[1] * scale**2 / 1e6


def _speed_path(cache: Path | None) -> Path:
    return (cache or notes_folder()) / "speed.json"


def _measured(path: Path) -> list[float]:
    """Return the slowness in recent lifts from speed.json; [] if the file is missing or implausible."""
    try:
        return [*read_record(_Speed, path, "Delete it.").slowness]
    except PlgsError:
        return []
