"""Findings on pictures and labels: blur, exposure, classes that contradict each other between views."""

from __future__ import annotations

import numpy as np

from ..scene import Scene
from ..scene.layout import listed
from .examined import Examined
from .finding import Finding
from .labels import LabelAgreement, measure_labels
from .photos import Photo, relative_sharpness
from .pictures import side_by_side
from .reprojection import Assumption, Floats

_BLURRED = 0.7
"""Of the neighbours' detail."""
_VERY_BLURRED = 0.35
_EXPOSURE = 1.5
"""Times brighter and darker that frames show the same surface, from the 5th to the 95th percentile."""
_CLIPPED = 0.5
_LEAST_FRAMES = 5
_FEWEST_POINTS = 100
_SURFACES_AGREE = 0.5
_UNRELATED = 0.5
_CONFUSED, _CONFUSED_SHARE = 0.25, 0.01
"""A class is contradicted when this part of it is called one other class, and that is this part of all points."""


def photo_findings(scene: Scene, photos: dict[int, Photo]) -> list[Finding]:
    """Frames that are blurred, black or white."""
    shots = list(photos.values())
    found = []
    if len(shots) >= _LEAST_FRAMES:
        sharpness = relative_sharpness(shots)
        blurred = [(value, shot) for value, shot in zip(sharpness.tolist(), shots, strict=True) if value < _BLURRED]
        if blurred:
            found.append(_of_blur(sorted(blurred, key=lambda each: each[0]), shots))
    clipped = [shot for shot in shots if shot.clipped > _CLIPPED]
    if clipped:
        names = tuple(shot.name for shot in clipped)
        found.append(
            Finding(
                cause="exposure",
                severity="note",
                text=f"in {len(clipped)} of {len(shots)} frames most pixels are black or white: {listed(names)}",
                option="leave them out with a splits.json",
                figures={"frames": float(len(clipped)), "clipped": max(shot.clipped for shot in clipped)},
                frames=names,
                picture=side_by_side([(shot.name, shot.grey) for shot in clipped[:2]]),
            )
        )
    return found


def _of_blur(blurred: list[tuple[float, Photo]], shots: list[Photo]) -> Finding:
    names = tuple(shot.name for _, shot in blurred)
    worst, shot = blurred[0]
    place = shots.index(shot)
    beside = shots[place - 1] if place else shots[1]
    drop = [each.name for value, each in blurred if value < _VERY_BLURRED]
    more = f"; {listed(drop)} may as well be left out" if drop else ""
    return Finding(
        cause="blur",
        severity="note",
        text=f"{len(blurred)} of {len(shots)} frames are less sharp than their neighbours, the worst with {worst:.0%} "
        f"of their detail: {listed(names)}{more}",
        option="none is needed: a lift counts them less; leave the worst out with a splits.json",
        figures={"frames": float(len(blurred)), "least_detail": worst},
        frames=names,
        picture=side_by_side([(beside.name, beside.grey), (shot.name, shot.grey)]),
    )


def exposure_findings(examined: Examined, assumed: Assumption) -> list[Finding]:
    """How much brighter some frames show a surface than others do."""
    gains = relative_gains(examined, assumed)
    if gains is None:
        return []
    low, high = np.quantile(gains, [0.05, 0.95])
    spread = float(np.exp(high - low))
    if spread < _EXPOSURE:
        return []
    dark, bright = int(np.argmin(gains)), int(np.argmax(gains))
    shown = [(examined.name(row), examined.photos[examined.looks[row].number].grey) for row in (dark, bright)]
    return [
        Finding(
            cause="exposure",
            severity="note",
            text=f"exposure varies: some frames show the same surface {spread:.1f} times as bright as others "
            f"(darkest {examined.name(dark)}, brightest {examined.name(bright)})",
            option="none is needed: a lift fits each frame's exposure; lock it when you record again",
            figures={"times": spread},
            picture=side_by_side(shown),
        )
    ]


def relative_gains(examined: Examined, assumed: Assumption) -> Floats | None:
    """The logarithm of how bright each look shows surfaces beside the others, float64 [F], of mean 0: least squares
    over the median ratios of the pairs; None where too few pairs see the same.
    """
    comparison = examined.views.compare(examined.pairs, assumed)
    rows, ratios = [], []
    for row, (one, other) in enumerate(examined.pairs.tolist()):
        same = comparison.agrees[row] > _SURFACES_AGREE
        if same.sum() < _FEWEST_POINTS / 2:
            continue
        ours = _brightness(examined, one, examined.views.places[one][same])
        theirs = _brightness(examined, other, comparison.place[row][same])
        fair = (ours > 12) & (ours < 243) & (theirs > 12) & (theirs < 243)
        if fair.sum() >= _FEWEST_POINTS / 4:
            rows.append((one, other))
            ratios.append(float(np.median(np.log(theirs[fair] / ours[fair]))))
    if len(rows) < len(examined.looks):
        return None
    system = np.zeros((len(rows), len(examined.looks)))
    system[np.arange(len(rows)), [one for one, _ in rows]] = -1.0
    system[np.arange(len(rows)), [other for _, other in rows]] = 1.0
    gains = np.linalg.lstsq(system, np.array(ratios), rcond=1e-6)[0]
    return gains - gains.mean()


def _brightness(examined: Examined, row: int, places: Floats) -> Floats:
    grey = examined.photos[examined.looks[row].number].grey
    height, width = grey.shape
    columns = np.clip((places[:, 0] * width).astype(np.int64), 0, width - 1)
    rows = np.clip((places[:, 1] * height).astype(np.int64), 0, height - 1)
    return grey[rows, columns].astype(np.float64)


def label_findings(examined: Examined, assumed: Assumption) -> list[Finding]:
    """Masks that contradict each other where views see the same surface. Raises SceneError."""
    labels = measure_labels(examined.views, examined.pairs, assumed, _FEWEST_POINTS)
    if labels is None or labels.counts.sum() < 10 * _FEWEST_POINTS:
        return []
    if labels.share < _UNRELATED:
        return [_of_all_masks(examined, labels)]
    middle = float(np.nanmedian(labels.by_look))
    odd = [row for row, share in enumerate(labels.by_look.tolist()) if share < _UNRELATED * middle]
    return [*([_of_masks(examined, labels, odd, middle)] if odd else []), *_confused(examined, labels)]


def _of_all_masks(examined: Examined, labels: LabelAgreement) -> Finding:
    return Finding(
        cause="contradicting masks",
        severity="wrong",
        text=f"views call only {labels.share:.0%} of the points the same that two of them see",
        option="see that each mask belongs to its frame, and that all have the same class table",
        figures={"share": labels.share},
        picture=_masks_shown(examined, [0, 1]),
    )


def _of_masks(examined: Examined, labels: LabelAgreement, rows: list[int], middle: float) -> Finding:
    names = tuple(examined.name(row) for row in rows)
    worst = float(min(labels.by_look[row] for row in rows))
    return Finding(
        cause="contradicting masks",
        severity="wrong",
        text=f"the masks of {listed(names)} contradict those of the other views: {worst:.0%} of their points are "
        f"called the same there, {middle:.0%} in the middle of all frames",
        option="see that these masks belong to these frames, or leave the frames out with a splits.json",
        figures={"share": worst, "middle": middle},
        frames=names,
        picture=_masks_shown(examined, [max(rows[0] - 1, 0), rows[0]]),
    )


def _confused(examined: Examined, labels: LabelAgreement) -> list[Finding]:
    """Pairs of classes that views exchange, the most frequent first."""
    total = labels.counts.sum()
    found = []
    for row, column in zip(*np.nonzero(labels.counts), strict=True):
        part = float(labels.counts[row, column] / labels.counts[row].sum())
        is_much = labels.counts[row, column] > _CONFUSED_SHARE * total
        if row != column and part > _CONFUSED and is_much:
            one, other = (examined.scene.classes[labels.class_ids[each]].name for each in (row, column))
            finding = Finding(
                cause="contradicting classes",
                severity="note",
                text=f"views contradict each other: {part:.0%} of what one calls {one} another calls {other}",
                option="a lift votes; see that the class table is the same for all masks",
                figures={"share": part, "class": one, "other": other},
                picture=_masks_shown(examined, _most_of(examined, labels.class_ids[row], labels.class_ids[column])),
            )
            found.append((float(labels.counts[row, column]), finding))
    return [finding for _, finding in sorted(found, key=lambda each: -each[0])]


def _most_of(examined: Examined, one: int, other: int) -> list[int]:
    """The look that shows most of the one class, and that of the other."""
    shares = [[(look.frame.mask(None).class_map() == each).mean() for look in examined.looks] for each in (one, other)]
    return [int(np.argmax(share)) for share in shares]


def _masks_shown(examined: Examined, rows: list[int]) -> np.ndarray:
    table = examined.scene.classes
    shown = []
    for row in rows:
        classes = examined.looks[row].frame.mask(None).class_map()
        colours = np.zeros((int(classes.max()) + 1, 3), np.uint8)
        for category in table.categories:
            if category.id < len(colours):
                colours[category.id] = category.colour
        shown.append((examined.name(row), colours[classes]))
    return side_by_side(shown)
