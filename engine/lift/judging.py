"""Evaluates a finished lift by the input masks, since there may be no ground truth: how well the lift and the masks
agree, which objects the lift misses, and how probable it is that a pixel's class is right."""

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
from ..metrics.calibration import MOST_SAMPLES, Calibration, Samples, calibrate, samples_of
from ..metrics.panoptic import PanopticEvaluation
from ..metrics.unshown import JudgedView, Unshown, find_unshown
from ..model.detail import finest_pixels
from ..passes.layers import PanopticLayers
from ..scene import Camera, ClassTable, Scene, Size, size_within
from ..scene.view import OnDemand, StoredViews, View, chained, load_view, made_ahead, read_ahead, stored

log = logging.getLogger("plgs.lift")

MOST_NAMED = 5
"""The most missing objects that the warning names. metrics.json lists all."""


@dataclass(frozen=True, eq=False)
class Judgement:
    """How the lift compares with the masks. ``trained``, ``held_back``: mean IoU over the masks' classes, for training
    and for held-out views; None without such views. ``not_shown``: objects in masks that the lift lacks.
    ``calibration``: turns the share of a class into a probability. ``doubt``: each view's mean probability that a class
    is wrong."""

    trained: float | None
    held_back: float | None
    not_shown: tuple[Unshown, ...]
    calibration: Calibration
    doubt: Mapping[str, float]

    def to_json(self) -> dict[str, Json]:
        """Return the value of "masks_as_judges" in metrics.json."""
        agreement: dict[str, Json] = {"trained": self.trained, "held_back": self.held_back}
        missed: list[Json] = [asdict(one) for one in self.not_shown]
        calibration: Json = asdict(self.calibration)
        return {"agreement": agreement, "not_shown": missed, "calibration": calibration, "doubt": dict(self.doubt)}

    def report(self, events: EventWriter) -> None:
        """Log the calibration and all missing objects, and warn of the first few objects."""
        log.info("confidence: %s", self.calibration)
        if self.held_back is None:
            log.info("no masks were held out, so confidence is judged by the masks that were trained on")
        judges: Json = {"not_shown": [asdict(one) for one in self.not_shown]}
        lines = [f"{text} (see frame {frame})" for text, frame in not_shown({"masks_as_judges": judges}, together=True)]
        for line in lines:
            log.info("not shown: %s", line)
        named = [*lines[:MOST_NAMED], *([f"and {len(lines) - MOST_NAMED} more"] if len(lines) > MOST_NAMED else [])]
        if named:
            events.warning(f"masks show objects that the lift does not show: {'; '.join(named)}")


def judge(
    draw: Callable[[Camera], PanopticLayers],
    scene: Scene,
    trained: Sequence[View],
    held_back: Sequence[View],
    *,
    progress: Callable[[int, int], object],
    scratch: Path | None = None,
) -> Judgement:
    """Compare the finished lift with the masks of the views it was ``trained`` on and of the views ``held_back``.
    ``draw`` renders it from a camera, with uncalibrated class shares. Raises PlgsError, OSError for bad files."""
    every = chained(trained, held_back)
    samples: list[Samples] = []
    most = MOST_SAMPLES // (len(held_back) or len(trained))

    def drawn() -> Iterator[NDArray[np.int32]]:
        """Yield the rendered class map of each view, int32 [H, W]; add up to ``most`` pixels to ``samples``."""
        drawings = made_ahead(every, lambda view: (view, draw(view.camera)))
        for number, (view, seen) in enumerate(drawings, start=1):
            samples.append(samples_of(view, seen.semantic, seen.confidence, most))
            yield seen.semantic
            progress(number, len(every))

    classes = stored(drawn(), scratch)
    judged = Samples(*map(np.concatenate, zip(*samples[len(trained) if len(held_back) else 0 :], strict=True)))
    calibration = calibrate(judged, trained, held_back)
    judges = OnDemand(len(every), lambda number: JudgedView(every[number], classes[number]))
    return Judgement(
        trained=_agreement(judges[: len(trained)], scene.classes),
        held_back=_agreement(judges[len(trained) :], scene.classes),
        not_shown=tuple(find_unshown(judges, scene.classes)),
        calibration=calibration,
        doubt={view.name: round(calibration.doubt(seen), 4) for view, seen in zip(every, samples, strict=True)},
    )


def evenly(views: Sequence[View], most: int) -> Sequence[View]:
    """Return at most ``most`` of the views, evenly spaced: comparing a view costs a rendering."""
    return views[:: -(-len(views) // most) or 1]  # without views the step would be 0


def read_held_back(scene: Scene, size: Size, scratch: Path | None = None) -> StoredViews:
    """Load the held-out frames with masks and depth, reduced to fit ``size``. Raises PlgsError for bad files."""
    masked = [frame for frame in scene.test_frames if frame.read_mask is not None and frame.read_depth is not None]
    return StoredViews(read_ahead(masked, lambda frame: load_view(frame, size_within(frame.size, size))), scratch)


def _agreement(judges: Sequence[JudgedView], classes: ClassTable) -> float | None:
    """Return the mean IoU over the classes that the masks contain; None if no pixel is labelled."""
    evaluation = PanopticEvaluation(classes, "strict")
    for judged in judges:
        nothing = np.zeros_like(judged.shown)
        evaluation.add(judged.shown, nothing, judged.view.mask.class_map(), nothing)
    return None if evaluation.is_empty else evaluation.result().miou_true


COARSER = 2.0
"""A photo resolves a surface if its pixels there are at most this many times as large as the picture's."""
LEAST_ALPHA = 0.5
"""Alpha below which a pixel shows no surface."""
SAMPLES = 5000
"""The approximate number of a picture's pixels that are checked, evenly spread."""
LEAST_UNRESOLVED = 0.1
"""Share of unresolved pixels above which a warning is given."""


@dataclass(frozen=True)
class Unresolved:
    """Two shares of a picture's pixels, 0 to 1: ``coarse``: a surface that no photo shows in enough resolution;
    ``empty``: no surface at all."""

    coarse: float
    empty: float

    @property
    def share(self) -> float:
        return self.coarse + self.empty


def unresolved(layers: PanopticLayers, camera: Camera, photos: Sequence[Camera], reduced: float = 1.0) -> Unresolved:
    """Return the share of ``camera``'s picture that no photo resolves, ignoring occlusion. ``layers`` is its rendering;
    ``reduced`` is how many times larger the final picture will be. ``photos`` are the cameras of the capture."""
    step = -int(-((camera.width * camera.height / SAMPLES) ** 0.5) // 1)
    first = (step - 1) // 2  # so that the margins are alike
    depth, alpha = (each[first::step, first::step] for each in (layers.depth, layers.combined[..., 3]))
    v, u = np.indices(depth.shape) * step + first + 0.5
    shown = (depth > 0) & (alpha >= LEAST_ALPHA)
    finest = finest_pixels(camera.points(u[shown], v[shown], depth[shown]), photos)
    away = np.ones_like(finest) if camera.projection == "orthographic" else depth[shown]
    own = away / (reduced * np.sqrt(camera.fx * camera.fy))
    coarse = (finest == 0) | (finest > COARSER * own)
    return Unresolved(np.count_nonzero(coarse) / depth.size, 1 - float(shown.mean()))


def report_unresolved(found: Sequence[tuple[str, Unresolved]], events: EventWriter, *, before: bool) -> None:
    """Warn if much of one of the views ``found`` is unresolved; unless ``before`` a bake, report all shares."""
    if not found:
        return
    mean = {name: float(np.mean([getattr(each, name) for _, each in found])) for name in ("coarse", "empty")}
    worst, most = max(found, key=lambda each: each[1].share)
    if not before:
        events.metric("unresolved", {"views": len(found), **mean, "worst": worst, "most": most.share})
    if most.share >= LEAST_UNRESOLVED:
        coarse, empty, views = mean["coarse"], mean["empty"], "the views to bake" if before else "the baked views"
        events.warning(
            f"the photos do not resolve {coarse + empty:.0%} of {views} ({most.share:.0%} of {worst}): {coarse:.0%} "
            f"is shown more than {COARSER:.0f} times as large as in any photo, {empty:.0%} has no surface"
        )
