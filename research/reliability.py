"""Measure how often pixels of a given confidence are right, against the ground truth of held-out frames, before and
after the masks calibrated the confidence."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from engine.corrections import read_corrected
from engine.gates import markdown_cell, plot_label
from engine.job import LiftFolder, verify_lifted
from engine.lift.baking import read_baker
from engine.lift.device import be_repeatable
from engine.scene import VOID, open_asked, size_within

BINS = 10
Curve = NDArray[np.float64]
"""float64 [3, BINS]: for each bin of the probability, the number of pixels, their mean probability, and the number of
right ones."""


def reliability(probability: NDArray[np.floating], right: NDArray[np.floating]) -> Curve:
    """Return the reliability curve of N pixels: for each bin of probability, the count, the mean probability and the
    fraction that is right. ``probability`` [N] of being right; ``right`` [N], 1 or 0."""
    number = np.clip((probability * BINS).astype(np.int64), 0, BINS - 1)  # 1.0 belongs to the last bin
    count = np.bincount(number, minlength=BINS)
    return np.stack([count, *(np.bincount(number, each, BINS) / np.maximum(count, 1) for each in (probability, right))])


def error(curve: Curve) -> float:
    """Return the expected calibration error of a curve."""
    return float((curve[0] * np.abs(curve[1] - curve[2])).sum() / max(curve[0].sum(), 1))


def pixels_of(lift: Path) -> NDArray[np.float32]:
    """Return, for all pixels of the held-out frames with ground truth, at the size of training: the share of the votes,
    the confidence, and whether the pixel is right, float32 [3, N]. Raises PlgsError for an unfinished lift; OSError."""
    folder, found = LiftFolder.open(lift), [np.zeros((3, 0), np.float32)]
    verify_lifted(folder.result_path)
    be_repeatable()
    scene = open_asked(folder.request)
    baker = read_baker(folder, scene.classes, read_corrected(folder.path))
    for frame in scene.test_frames:
        if frame.read_ground_truth is not None:
            size = size_within(frame.size, folder.request.chosen_preset.size)
            seen = baker.decided(frame.camera.resized(*size), wanted=("semantic", "confidence"))
            truth = frame.read_ground_truth(size).semantic
            known = (seen.semantic != VOID) & (truth != VOID)
            share, right = seen.confidence[known], seen.semantic[known] == truth[known]
            found.append(np.stack([share, baker.calibration(share), right]).astype(np.float32))
    return np.concatenate(found, axis=1)


def reliability_table(lifts: Sequence[Path], picture: Path | None) -> Iterator[str]:
    """Yield lines of Markdown: the expected calibration error of each lift and of all together; and draw a diagram into
    the file ``picture``, if given. Raises PlgsError for a bad lift; OSError."""
    found = {lift.name: pixels_of(lift) for lift in lifts}
    found["all together"] = np.concatenate([*found.values()], axis=1)
    curves = {name: [reliability(each, pixels[2]) for each in pixels[:2]] for name, pixels in found.items()}
    yield "| lift | right | share of the votes, error | Confidence, error |"
    yield "|---|---|---|---|"
    for name, (before, after) in curves.items():
        right = 100 * found[name][2].mean(dtype=np.float64)
        yield f"| {markdown_cell(name)} | {right:.1f} % | {error(before):.3f} | {error(after):.3f} |"
    if picture is not None:
        draw(picture, curves)


def draw(path: Path, curves: dict[str, list[Curve]]) -> None:
    """Draw the share of right pixels over share of votes and confidence, with matplotlib. Raises OSError."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 3.6), layout="constrained")
    for number, title in enumerate(("share of the votes", "Confidence")):
        axes = figure.add_subplot(1, 2, number + 1, xlabel=title, ylabel="pixels that are right")
        axes.plot((0, 1), (0, 1), color="grey", linewidth=1)
        for name, pair in curves.items():
            _, probability, right = (curve := pair[number])[:, pair[number][0] > 0.002 * pair[number][0].sum()]
            axes.plot(probability, right, "o-", markersize=4, label=f"{plot_label(name)}, error {error(curve):.3f}")
        axes.set(xlim=(0, 1), ylim=(0, 1))
        axes.legend(fontsize=8)
    figure.savefig(path, dpi=90)
