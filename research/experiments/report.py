"""What an experiment leaves behind: results.json and .csv, tables in Markdown, plots, contact sheets, an updated
page."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from statistics import mean
from typing import NamedTuple

import numpy as np

from engine.errors import PlgsError
from engine.gates import plot_label
from engine.job import write_atomically
from engine.passes.previews import first_row, png_bytes

from ..results import csv_text, results_text
from .rows import Row
from .table import MEANS, Tables

BEGIN, END = "<!-- tables: made by `python -m research experiments` -->", "<!-- end of the tables -->"
SHEET = Path("result/previews/contact_sheet.png")
SHOWN = (("miou", "mIoU"), ("pq", "PQ-scene"))
COLOURS = ("#4c78a8", "#f58518")
_SKELETON = """# Experiments

The paper's tables on open data, baselines included; `python -m research experiments --report docs/experiments.md`
brings the tables up to date. Figures in per cent unless said otherwise, on held-out frames; in the last column what the
paper reports as mIoU / PQ-scene, on other scenes, with other masks and many more steps. LPIPS is not measured: it needs
the weights of a network.
"""


def write_report(
    folder: Path, tables: Tables, *, sheets: Mapping[str, Path] | None = None, page: Path | None = None
) -> None:
    """results.json, results.csv and results.md; with ``sheets`` (caption to the lift's folder), at the end, also the
    plots and sheet.png, and in ``page`` the sections of these scenes. Raises PlgsError when they cannot be written."""
    try:
        write_atomically(folder / "results.json", results_text(tables.results))
        write_atomically(folder / "results.csv", csv_text(tables.results))
        write_atomically(folder / "results.md", tables.markdown())
        if sheets is None:
            return
        write_sheet(folder / "sheet.png", sheets)
        if not write_plots(folder / "plots", tables):
            print("No plots: matplotlib is not installed (requirements/report.txt).", file=sys.stderr)
    except OSError as error:
        fix = "Make room there, or choose a folder that you may write to with -o."
        raise PlgsError("unwritable", f"the results cannot be written ({error.strerror})", folder, fix) from error
    if page is not None:
        _bring_up_to_date(page, tables)


def _bring_up_to_date(page: Path, tables: Tables) -> None:
    try:
        write_atomically(page, with_tables(text_of(page), tables.markdown()))
    except OSError as error:
        fix = "Make room there, or name another page with --report."
        raise PlgsError("unwritable", f"the report's page cannot be written ({error.strerror})", page, fix) from error


def refuse_unwritable(page: Path) -> None:
    """Before hours of work: raise PlgsError if the tables of ``page`` could not be updated at the end."""
    text_of(page)
    folder = next(each for each in page.absolute().parents if each.exists())  # missing folders below it are made
    if not folder.is_dir() or not os.access(folder, os.W_OK):
        what = "the report's page cannot be written"
        raise PlgsError("unwritable", what, page, "Name a file in a folder that you may write to.")


def text_of(page: Path) -> str:
    """The text of a page, empty where there is no such file. Raises PlgsError for a file that is not text."""
    try:
        return page.read_text("utf-8") if page.exists() else ""
    except (OSError, UnicodeDecodeError) as error:
        what = "the report's page is not a text file"
        raise PlgsError("not-text", what, page, "Name a Markdown file, or a new one.") from error


def with_tables(page: str, tables: str) -> str:
    """The page with these scenes' sections between its marks, in place of the ones of the same scenes there; at its end
    if it has no marks."""
    if BEGIN not in page or END not in page:
        page = f"{page or _SKELETON}\n{BEGIN}\n{END}\n"
    before, _, rest = page.partition(BEGIN)
    old, _, after = rest.partition(END)
    sections = {**_sections(old), **_sections(tables)}
    if means := sections.pop(MEANS, ""):
        sections[MEANS] = means  # the last section, after new scenes
    return f"{before}{BEGIN}\n\n{chr(10).join(sections.values())}\n{END}{after}"


def _sections(tables: str) -> dict[str, str]:
    """The sections of a text by the scenes that head them."""
    parts = re.split(r"^(?=### )", tables, flags=re.MULTILINE)
    return {part.partition("\n")[0]: part.rstrip("\n") + "\n" for part in parts if part.startswith("### ")}


def write_sheet(path: Path, lifts: Mapping[str, Path]) -> None:
    """The first held-out frame of each lift (caption to folder): photo, input mask, lifted classes and instances.
    Nothing where no lift has a contact sheet. Raises OSError."""
    strips = [first_row(lift / SHEET, caption) for caption, lift in lifts.items() if (lift / SHEET).is_file()]
    if strips:
        width = max(strip.shape[1] for strip in strips)
        wide = [np.pad(strip, ((0, 0), (0, width - strip.shape[1]), (0, 0))) for strip in strips]
        write_atomically(path, png_bytes(np.concatenate(wide)))


class Bars(NamedTuple):
    """A plot: the names of its rows and, for each of SHOWN, their values in per cent, 0 where there is none."""

    title: str
    names: list[str]
    values: list[list[float]]


def write_plots(folder: Path, tables: Tables) -> bool:
    """folder/<scene>-<table>.png; False if matplotlib is not installed. Raises OSError."""
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
    axes.set_yticks([p + 0.2 for p in places], [plot_label(name) for name in bars.names])
    axes.invert_yaxis()
    axes.set(title=plot_label(bars.title), xlabel="per cent", xlim=(0, 100))
    axes.legend(loc="lower right")
    figure.savefig(path, dpi=110)
    pyplot.close(figure)
