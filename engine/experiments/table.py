"""The figures of all rows as tables in Markdown, beside those that the paper reports."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from statistics import mean, stdev

from .. import __version__
from .figures import Figures, Result
from .rows import Cited, Row, Rows


@dataclass(frozen=True)
class Column:
    """How a figure (a field of Figures) is shown: times ``factor``, with so many digits after the point."""

    figure: str
    heading: str
    factor: float
    digits: int


COLUMNS = (
    Column("miou", "mIoU %", 100.0, 1),
    Column("pq", "PQ-scene %", 100.0, 1),
    Column("miou_pl_compat", "mIoU % `pl_compat`", 100.0, 1),
    Column("pq_pl_compat", "PQ-scene % `pl_compat`", 100.0, 1),
    Column("pq_frame", "PQ a frame %", 100.0, 1),
    Column("id_changes", "id changes an object", 1.0, 2),
    Column("psnr", "PSNR dB", 1.0, 2),
    Column("psnr_fitted", "PSNR dB, colours fitted", 1.0, 2),
    Column("ssim", "SSIM", 1.0, 3),
    Column("depth_error_m", "depth error cm", 100.0, 1),
    Column("seconds", "lift s", 1.0, 0),
    Column("peak_bytes", "peak GB", 1e-9, 1),
    Column("fps", "panoptic frames/s", 1.0, 1),
)

MARK = "†"


@dataclass(frozen=True)
class Tables:
    """Everything that tables are made of: the ``chosen`` rows of ``rows``, what was measured so far, and earlier
    results to compare with, "before -> after". ``version`` of the engine: what another one lifted is marked."""

    rows: Rows
    chosen: tuple[Row, ...]
    results: tuple[Result, ...]
    earlier: tuple[Result, ...] = ()
    version: str = __version__

    def markdown(self) -> str:
        """A section a scene, in it a table each; rows that are not measured yet are left out."""
        scenes = dict.fromkeys(result.scene for result in self.results)
        return "\n".join(text for scene in scenes for text in self._of_scene(scene))

    def _of_scene(self, scene: str) -> Iterator[str]:
        yield f"### {scene}\n"
        for table, heading in self.rows.tables.items():
            lines = list(self.lines(scene, [row for row in self.chosen if row.table == table]))
            if lines:
                yield f"**{heading}**\n"
                yield "\n".join(lines) + "\n"

    def lines(self, scene: str, rows: Sequence[Row]) -> Iterator[str]:
        """The table of some rows, as far as they were measured; nothing where none was."""
        measured = {row.name: self.figures(scene, row) for row in rows}
        rows = [row for row in rows if measured[row.name] or row.is_cited]
        if not any(measured.values()):
            return
        cells = {row.name: dict(_cells(measured[row.name], self._before(scene, row))) for row in rows}
        shown = [column for column in COLUMNS if any(cells[row.name][column.figure] for row in rows)]
        with_paper = any(row.paper for row in rows)
        heading = ["", *(column.heading for column in shown), *(["in the paper"] if with_paper else [])]
        others = {row.name: self._other_versions(scene, row) for row in rows}
        names = {name: f"{name} {MARK}" if versions else name for name, versions in others.items()}
        body = [[names[row.name], *(cells[row.name][column.figure] for column in shown)] for row in rows]
        if with_paper:
            body = [[*line, _cited(row.paper)] for line, row in zip(body, rows, strict=True)]
        yield from _aligned([heading, *body])
        if marked := sorted(set().union(*others.values())):
            yield f"\n{MARK} Lifted by the engine {', '.join(marked)}, not by this one, {self.version}."

    def figures(self, scene: str, row: Row) -> list[Figures]:
        """What was measured of a row, seed by seed."""
        return [result.figures for result in _results_of(self.results, scene, self.measured_as(row))]

    def _other_versions(self, scene: str, row: Row) -> set[str]:
        """Of the engines that measured a row, those that are not this one."""
        return {result.engine_version for result in self._results(scene, row)} - {self.version}

    def _results(self, scene: str, row: Row) -> list[Result]:
        return _results_of(self.results, scene, self.measured_as(row))

    def _before(self, scene: str, row: Row) -> list[Figures]:
        return [result.figures for result in _results_of(self.earlier, scene, self.measured_as(row))]

    def measured_as(self, row: Row) -> str:
        """What a row's results are called."""
        if row.method:
            return f"{row.method}, {row.masks}" if row.masks else row.method
        return self.rows.lift_of(row).name


def _results_of(results: Sequence[Result], scene: str, name: str) -> list[Result]:
    return [result for result in results if (result.scene, result.row) == (scene, name)]


def _cells(now: Sequence[Figures], before: Sequence[Figures]) -> Iterator[tuple[str, str]]:
    for column in COLUMNS:
        text, earlier = _cell(now, column), _cell(before, column)
        yield column.figure, f"{earlier or '-'} -> {text or '-'}" if earlier or (before and text) else text


def _cell(seeds: Sequence[Figures], column: Column) -> str:
    """The mean over the seeds, with their standard deviation where there are several; empty where nothing was
    measured."""
    values = [value * column.factor for figures in seeds if (value := getattr(figures, column.figure)) is not None]
    if not values:
        return ""
    text = f"{mean(values):.{column.digits}f}"
    return f"{text} ± {stdev(values):.{column.digits}f}" if len(values) > 1 else text


def _cited(paper: Cited | None) -> str:
    """Such as "71.2 / 57.8 / 36.6 dB (Replica)"."""
    if paper is None:
        return ""
    shares = [f"{value:.1f}" if value is not None else "-" for value in (paper.miou, paper.pq)]
    psnr = [] if paper.psnr is None else [f"{paper.psnr:.1f} dB"]
    return f"{paper.note or ' / '.join([*shares, *psnr])} ({paper.dataset})"


def _aligned(rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """The first column flush left, figures flush right."""
    widths = [max(3, *(len(row[place]) for row in rows)) for place in range(len(rows[0]))]
    rule = ["-" * widths[0], *("-" * (width - 1) + ":" for width in widths[1:])]
    for row in [rows[0], rule, *rows[1:]]:
        cells = zip(row, widths, strict=True)
        yield f"| {' | '.join(c.rjust(w) if place else c.ljust(w) for place, (c, w) in enumerate(cells))} |"
