"""The tables as bars: mIoU and PQ-scene of the rows, a plot a table and scene."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from statistics import mean
from typing import NamedTuple

from .rows import Row
from .table import Tables

SHOWN = (("miou", "mIoU"), ("pq", "PQ-scene"))
COLOURS = ("#4c78a8", "#f58518")


class Bars(NamedTuple):
    """A plot: its rows' names, and in per cent for each of SHOWN their values, 0 where there is none."""

    title: str
    names: list[str]
    values: list[list[float]]


def write_plots(folder: Path, tables: Tables) -> bool:
    """folder/<scene>-<table>.png; False where matplotlib is not installed. Raises OSError."""
    if find_spec("matplotlib") is None:
        return False
    for scene in dict.fromkeys(result.scene for result in tables.results):
        for table, heading in tables.rows.tables.items():
            rows = [row for row in tables.chosen if row.table == table and tables.measured(scene, row)]
            if len(rows) > 1:
                folder.mkdir(parents=True, exist_ok=True)
                _draw(folder / f"{scene}-{table}.png", bars_of(f"{heading} ({scene})", scene, rows, tables))
    return True


def bars_of(title: str, scene: str, rows: Sequence[Row], tables: Tables) -> Bars:
    """Means over the seeds."""
    values = [[_mean(scene, row, figure, tables) for row in rows] for figure, _ in SHOWN]
    return Bars(title, [row.name for row in rows], values)


def _mean(scene: str, row: Row, figure: str, tables: Tables) -> float:
    found: Iterator[float | None] = (getattr(one.figures, figure) for one in tables.measured(scene, row))
    known = [100 * value for value in found if value is not None]
    return mean(known) if known else 0.0


def _draw(path: Path, bars: Bars) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(9, 1.2 + 0.5 * len(bars.names)), layout="constrained")
    places = range(len(bars.names))
    for number, ((_, label), values) in enumerate(zip(SHOWN, bars.values, strict=True)):
        drawn = axes.barh([p + 0.4 * number for p in places], values, 0.38, label=label, color=COLOURS[number])
        axes.bar_label(drawn, fmt="%.1f", padding=3, fontsize=8)
    axes.set_yticks([p + 0.2 for p in places], bars.names)
    axes.invert_yaxis()
    axes.set(title=bars.title, xlabel="per cent", xlim=(0, 100))
    axes.legend(loc="lower right")
    figure.savefig(path, dpi=110)
    pyplot.close(figure)
