"""The masks judge the finished lift, as there may be no ground truth: how well it agrees with them, and what they show
clearly from nearby that it shows nowhere."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..job import EventWriter
from ..job.report import not_shown
from ..json_file import Json
from ..metrics.panoptic import PanopticEvaluation
from ..metrics.unshown import JudgedView, Unshown, find_unshown
from ..scene import (
    Camera,
    ClassTable,
    OnDemand,
    Scene,
    Size,
    StoredViews,
    View,
    chained,
    load_view,
    read_ahead,
    size_within,
    stored,
)

log = logging.getLogger("plgs.lift")

MOST_VIEWS = 100
"""The most training views that judge, evenly chosen. Each is drawn once, at the size of training."""
MOST_NAMED = 5
"""The most missing objects that the warning names. metrics.json and the log list all of them."""


@dataclass(frozen=True, eq=False)
class Seen:
    """What a camera sees of a lift: ``classes`` int32 [H, W] (0 = nothing), and the mean normalised ``entropy`` of the
    classes of the pixels that show something."""

    classes: NDArray[np.int32]
    entropy: float


@dataclass(frozen=True, eq=False)
class Judgement:
    """How the masks judge a lift. ``trained`` and ``held_back``: the mean IoU with the masks over the masks' own
    classes, for training views and for held-out views; None without such views. ``entropy``: how uncertain the lift is
    about the classes in each frame that was judged, from 0 to 1."""

    trained: float | None
    held_back: float | None
    not_shown: tuple[Unshown, ...]
    entropy: Mapping[str, float]

    def to_json(self) -> dict[str, Json]:
        """The value under "masks_as_judges" in metrics.json."""
        agreement: dict[str, Json] = {"trained": self.trained, "held_back": self.held_back}
        missed: list[Json] = [asdict(one) for one in self.not_shown]
        return {"agreement": agreement, "not_shown": missed, "entropy": dict(self.entropy)}

    def tell(self, events: EventWriter) -> None:
        """Log everything that the lift does not show, and give a warning with the first few."""
        lines = [f"{text} (see frame {frame})" for text, frame in not_shown({"masks_as_judges": self.to_json()})]
        for line in lines:
            log.info("not shown: %s", line)
        if lines:
            more = f"; and {len(lines) - MOST_NAMED} more" if len(lines) > MOST_NAMED else ""
            events.warning(f"the masks show objects that the lift does not: {'; '.join(lines[:MOST_NAMED])}{more}")


def judge(
    draw: Callable[[Camera], Seen],
    scene: Scene,
    views: Sequence[View],
    size: Size,
    progress: Callable[[int, int], object],
    scratch: Path | None = None,
) -> Judgement:
    """Judge the finished lift by the training ``views`` and the held-out frames, which are read within ``size``.

    ``draw`` returns what a camera sees of it. Raises PlgsError, OSError, and what ``progress`` raises.
    """
    trained = views[:: -(-len(views) // MOST_VIEWS) or 1]
    masked = [frame for frame in scene.test_frames if frame.read_mask is not None and frame.read_depth is not None]
    read = read_ahead(masked, lambda frame: load_view(frame, size_within(frame.size, size)))
    held_back = StoredViews(read, scratch)
    every = chained(trained, held_back)
    entropy: dict[str, float] = {}
    classes = stored(_drawn(draw, every, entropy, progress), scratch)
    judges = OnDemand(len(every), lambda number: JudgedView(every[number], classes[number]))
    return Judgement(
        trained=_agreement(judges[: len(trained)], scene.classes),
        held_back=_agreement(judges[len(trained) :], scene.classes),
        not_shown=tuple(find_unshown(judges, scene.classes)),
        entropy=entropy,
    )


def _drawn(
    draw: Callable[[Camera], Seen],
    views: Sequence[View],
    entropy: dict[str, float],
    progress: Callable[[int, int], object],
) -> Iterator[NDArray[np.int32]]:
    """The classes that each view shows; their mean entropy goes into ``entropy``."""
    for number in range(len(views)):
        view = views[number]
        seen = draw(view.camera)
        entropy[view.name] = round(seen.entropy, 4)
        yield seen.classes
        progress(number + 1, len(views))


def _agreement(judges: Sequence[JudgedView], classes: ClassTable) -> float | None:
    """The mean IoU over the classes of the masks; None if no pixel is labelled."""
    evaluation = PanopticEvaluation(classes, "strict")
    for judged in judges:
        nothing = np.zeros_like(judged.shown)
        evaluation.add(judged.shown, nothing, judged.view.mask.class_map(), nothing)
    return None if evaluation.is_empty else evaluation.result().miou_true
