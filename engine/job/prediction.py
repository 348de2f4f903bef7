"""How long a lift will take and how much memory it needs, before it is begun.

The constants were measured on lifts of the bundled sample (72 frames of 320x240) on two cores of a 2.5 GHz Xeon; how
much slower or faster this machine is, finished lifts tell. What is not known before is how much surface the cameras
see: that of the sample is taken.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from .atomic import write_atomically
from .effort import Effort
from .errors import JobError
from .json_file import read_object, to_text
from .lock import FileLock
from .user_cache import notes_folder

FORMAT = 1
SURFACE = 400.0
"""Square metres that the sample's frames see: what anchors lie on."""
MOST_ANCHORS_PER_POINT = 0.8
REMEMBERED = 5
MB = 1_000_000


@dataclass(frozen=True)
class Prediction:
    """``stages``: seconds by stage name, in their order, "start" and "prepare" (before training) among them;
    ``peak_bytes``: the most main memory that the engine holds at once."""

    stages: Mapping[str, float]
    peak_bytes: int

    @property
    def seconds(self) -> float:
        return sum(self.stages.values())


def predict(
    train_frames: int,
    test_frames: int,
    frame_size: tuple[int, int],
    effort: Effort,
    *,
    bake: str = "test",
    slowness: float = 1.0,
) -> Prediction:
    """For ``train_frames`` + ``test_frames`` pictures of ``frame_size`` (width, height) pixels. ``bake``: as in a
    request; ``slowness``: see `machine_slowness`."""
    frames = train_frames + test_frames
    own = frame_size[0] * frame_size[1] / 1e6
    trained_on = _megapixels_within(frame_size, effort.size_within)
    seen = train_frames * trained_on
    baked = {"test": test_frames, "all": frames, "none": 0}[bake]
    steps = effort.steps_for(train_frames)
    step = step_seconds(trained_on, _millions_of_gaussians(effort))
    rounds = max(0, min(round(1 / effort.self_training_every), steps) - 1)
    stages = {
        "start": 4.0,
        "check": 0.1 + 0.14 * frames * own,
        "read": 0.07 * train_frames * own,
        "consistency": 1.3 + 1.6 * seen,
        "match": 1.1 + 0.7 * seen,
        "prepare": 10.0 + 2.3 * seen,
        "train": steps * step + rounds * train_frames * 0.42 * step,
        "result": 0.5 + 2.75 * _millions_of_gaussians(effort),
        "bake": baked * (0.2 + 10.0 * own),
        "evaluate": 0.2 + 0.65 * frames * own,
    }
    return Prediction({name: slowness * seconds for name, seconds in stages.items()}, _peak_bytes(seen, own, effort))


def step_seconds(megapixels: float, millions_of_gaussians: float) -> float:
    """A training step on the machine that the constants were measured on: for a picture of that size, of a model with
    so many Gaussians in all."""
    return 0.03 + 0.55 * megapixels + 0.3625 * millions_of_gaussians


def machine_slowness(cache: Path | None = None) -> float:
    """How many times longer this machine takes, from the lifts it finished lately; 1 before the first. Never raises."""
    measured = _measured(_speed_path(cache))
    return median(measured) if measured else 1.0


def learn_slowness(seconds: float, megapixels: float, millions_of_gaussians: float, cache: Path | None = None) -> None:
    """Remember that a step of a finished lift took so long here. Raises OSError, JobError."""
    path = _speed_path(cache)
    path.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(path.with_suffix(".lock")):
        measured = [*_measured(path), seconds / step_seconds(megapixels, millions_of_gaussians)]
        write_atomically(path, to_text({"format": FORMAT, "slowness": measured[-REMEMBERED:]}))


def _peak_bytes(seen: float, own: float, effort: Effort) -> int:
    """``seen``: megapixels of all training pictures; ``own``: of one frame, which is baked at its own size."""
    return round((1000 + 125 * seen + 300 * own + 400 * _millions_of_gaussians(effort)) * MB)


def _millions_of_gaussians(effort: Effort) -> float:
    """About as many as the sample gives."""
    most = min(effort.most_anchors, MOST_ANCHORS_PER_POINT * effort.most_points)
    return effort.gaussians_per_anchor * min(SURFACE / effort.voxel_size**2, most) / 1e6


def _megapixels_within(size: tuple[int, int], box: tuple[int, int]) -> float:
    scale = min(1.0, box[0] / size[0], box[1] / size[1])
    return size[0] * size[1] * scale**2 / 1e6


def _speed_path(cache: Path | None) -> Path:
    return (cache or notes_folder()) / "speed.json"


def _measured(path: Path) -> list[float]:
    """Empty when there is nothing, or nothing that makes sense."""
    try:
        content = read_object(path, "Delete it.")
    except JobError:
        return []
    values = content.get("slowness")
    if content.get("format") != FORMAT or not isinstance(values, list):
        return []
    return [float(value) for value in values if isinstance(value, int | float) and 0.001 < value < 1000]
