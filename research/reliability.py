"""How often pixels are right, by their confidence: against the ground truth of held-out frames, before and after the
masks calibrated it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from engine.corrections import read_corrected
from engine.gates import markdown_cell, plot_label
from engine.job import LiftFolder, verify_lifted
from engine.lift.baking import read_baker
from engine.lift.device import be_repeatable
from engine.scene import VOID, open_asked, size_within

BINS = 10


class Reliability(NamedTuple):
    """For each bin of the probability: how many ``pixels`` int64 [BINS], their mean ``probability`` and how many are
    ``right``, 0..1; 0 where none."""

    pixels: NDArray[np.int64]
    probability: NDArray[np.float64]
    right: NDArray[np.float64]

    @property
    def error(self) -> float:
        """The expected calibration error."""
        return float((self.pixels * np.abs(self.probability - self.right)).sum() / max(self.pixels.sum(), 1))


def reliability(probability: NDArray[np.floating], right: NDArray[np.bool_]) -> Reliability:
    """Of pixels [N] that are right or not."""
    number = np.clip((probability * BINS).astype(np.int64), 0, BINS - 1)
    count = np.bincount(number, minlength=BINS)
    means = (np.bincount(number, each, BINS) / np.maximum(count, 1) for each in (probability, right))
    return Reliability(count, *means)


def shares_of(lift: Path) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
    """The shares, the probabilities, and what is right, [N], of all pixels of the held-out frames with ground truth, at
    the size of training. Raises PlgsError, OSError."""
    folder = LiftFolder.open(lift)
    verify_lifted(folder.result_path)
    be_repeatable()
    scene, shares, right = open_asked(folder.request), [np.zeros(0, np.float32)], [np.zeros(0, bool)]
    baker = read_baker(folder, scene.classes, read_corrected(folder.path))
    for frame in scene.test_frames:
        if frame.read_ground_truth is not None:
            size = size_within(frame.size, folder.request.chosen_preset.size)
            seen, truth = baker.seen(frame.camera.resized(*size)), frame.read_ground_truth(size).semantic
            known = (seen.classes != VOID) & (truth != VOID)
            shares.append(seen.share[known])
            right.append(seen.classes[known] == truth[known])
    share = np.concatenate(shares)
    return share, baker.calibration(share), np.concatenate(right)


def reliability_table(lifts: Sequence[Path], picture: Path | None) -> Iterator[str]:
    """Lines of Markdown: the expected calibration error of each lift and of all together; and a diagram. Raises
    PlgsError, OSError."""
    found = [shares_of(lift) for lift in lifts]
    names = [lift.name for lift in lifts]
    if len(found) > 1:
        together = (np.concatenate(each) for each in zip(*found, strict=True))
        found, names = [*found, tuple(together)], [*names, "all"]
    yield "| lift | right | share, error | confidence, error |"
    yield "|---|---|---|---|"
    curves = [(reliability(share, right), reliability(likely, right)) for share, likely, right in found]
    for name, (_, _, right), (before, after) in zip(names, found, curves, strict=True):
        yield f"| {markdown_cell(name)} | {100 * right.mean():.1f} % | {before.error:.3f} | {after.error:.3f} |"
    if picture is not None:
        draw(picture, names, curves)


def draw(path: Path, names: Sequence[str], curves: Sequence[tuple[Reliability, Reliability]]) -> None:
    """The diagram: how much is right over the share, and over the confidence. Needs matplotlib. Raises OSError."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, panels = pyplot.subplots(1, 2, figsize=(7, 3.6), sharey=True, layout="constrained")
    for number, (axes, title) in enumerate(zip(panels, ("share of the votes", "Confidence"), strict=True)):
        axes.plot((0, 1), (0, 1), color="grey", linewidth=1)
        for name, pair in zip(names, curves, strict=True):
            curve = pair[number]
            many = curve.pixels > 0.002 * curve.pixels.sum()
            label = f"{plot_label(name)}, error {curve.error:.3f}"
            axes.plot(curve.probability[many], curve.right[many], marker="o", markersize=4, label=label)
        axes.set(xlabel=title, xlim=(0, 1), ylim=(0, 1))
        axes.legend(fontsize=8)
    panels[0].set_ylabel("pixels that are right")
    figure.savefig(path, dpi=90)
    pyplot.close(figure)
