"""The figures of all rows as tables in Markdown, beside the paper's."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from statistics import mean, stdev

from engine.gates import markdown_cell

from ..results import Result, this_engine
from .rows import Cited, Row, Rows


@dataclass(frozen=True)
class Column:
    """How a figure (a field of Figures, or "steps") is shown: times ``factor``, with ``digits`` after the point.
    ``best`` says which of several seeds is shown, as for times, which other load only makes worse; without it, mean and
    standard deviation are shown."""

    figure: str
    heading: str
    factor: float
    digits: int
    best: Callable[[Sequence[float]], float] | None = None

    def values(self, seeds: Sequence[Result]) -> list[float]:
        """Return the figures as shown, of the seeds in which they were measured."""
        found = [one.steps or None if self.figure == "steps" else getattr(one.figures, self.figure) for one in seeds]
        return [value * self.factor for value in found if value is not None]


COLUMNS = (
    Column("miou", "mIoU %", 100.0, 1),
    Column("miou_true", "mIoU % true classes", 100.0, 1),
    Column("pq", "PQ-scene %", 100.0, 1),
    Column("miou_pl_compat", "mIoU % `pl_compat`", 100.0, 1),
    Column("miou_true_pl_compat", "mIoU % `pl_compat`, true classes", 100.0, 1),
    Column("pq_pl_compat", "PQ-scene % `pl_compat`", 100.0, 1),
    Column("pq_frame", "per-frame PQ %", 100.0, 1),
    Column("id_changes", "id changes per object", 1.0, 2),
    Column("psnr", "PSNR dB", 1.0, 2),
    Column("psnr_fitted", "PSNR dB, colours fitted", 1.0, 2),
    Column("ssim", "SSIM", 1.0, 3),
    Column("depth_error_m", "depth error cm", 100.0, 1),
    Column("steps", "steps", 1.0, 0, max),
    Column("seconds", "lift s", 1.0, 0, min),
    Column("peak_bytes", "peak GB", 1e-9, 1, max),
    Column("fps", "panoptic frames/s", 1.0, 1, max),
)

ON_PAGE = ("scenes", "miou", "pq", "miou_pl_compat", "pq_pl_compat", "psnr", "depth_error_m", "seconds", "state")
"""The columns of results.md; results.csv and what is printed have all."""
HEADINGS = {"scenes": "scenes", **{column.figure: column.heading for column in COLUMNS}, "state": "state"}
_WIDEST = 60
MARK = "†"


@dataclass(frozen=True)
class Tables:
    """Everything in the tables: the ``chosen`` rows of ``rows``, and the results so far. ``version`` is the engine's:
    lifts by other versions are marked. ``columns`` are those shown."""

    rows: Rows
    chosen: tuple[Row, ...]
    results: tuple[Result, ...]
    version: str = field(default_factory=this_engine)
    columns: tuple[str, ...] = tuple(HEADINGS)

    def markdown(self) -> str:
        """Return Markdown with a section of tables for each scene, and one for the means over several scenes. It leaves
        out rows that are not measured yet, tables whose rows all appear in another one and, after the first scene, the
        cited systems."""
        scenes = list(dict.fromkeys(result.scene for result in self.results))
        lines = [text for k, scene in enumerate(scenes) for text in self._of_scene(scene, with_cited=k == 0)]
        return "\n".join([*lines, *(self._means(scenes) if len(scenes) > 1 else ())])

    def _of_scene(self, scene: str, *, with_cited: bool) -> Iterator[str]:
        yield f"### {scene}\n"
        for heading, rows in self._of_tables([scene]):
            rows = [row for row in rows if with_cited or not row.is_cited]
            yield f"**{heading}**\n"
            yield "\n".join(self.lines(scene, rows)) + "\n"

    def _of_tables(self, scenes: Sequence[str]) -> Iterator[tuple[str, list[Row]]]:
        """Yield heading and rows of each table with a result of its own, not another row's, in one of the scenes."""
        for table, heading in self.rows.tables.items():
            rows = [row for row in self.chosen if row.table == table]
            if any(self._tried(scene, row) and not row.same_as for row in rows for scene in scenes):
                yield heading, rows

    def lines(self, scene: str, rows: Sequence[Row]) -> Iterator[str]:
        """Yield the lines of a table of those rows that were tried; none if none was."""
        rows = [row for row in rows if self._tried(scene, row) or row.is_cited]
        if all(row.is_cited for row in rows):
            return
        cells = {
            row.name: {column.figure: _cell(self.measured(scene, row), column) for column in COLUMNS}
            | {"state": self._failures(scene, row)}
            for row in rows
        }
        names, marked = [], set[str]()
        for row in rows:
            others = {result.engine_version for result in self.measured(scene, row)} - {self.version}
            names.append(f"{row.name}{' (cited)' if row.is_cited else ''}{f' {MARK}' if others else ''}")
            marked |= others
        yield from self._table(rows, names, cells)
        if marked:
            yield f"\n{MARK} Lifted by the engine {', '.join(sorted(marked))}, not by this one, {self.version}."

    def _means(self, scenes: Sequence[str]) -> Iterator[str]:
        yield "### Means: over the scenes\n"
        yield (
            f"Of {len(scenes)} scenes: {', '.join(scenes)}. *scenes* says in how many a row was measured; in brackets "
            "is the number of those that have a figure, if not all have it.\n"
        )
        for heading, rows in self._of_tables(scenes):
            rows = [row for row in rows if any(self._tried(scene, row) for scene in scenes)]
            cells = {row.name: self._mean_cells(row, scenes) for row in rows}
            yield f"**{heading}**\n"
            yield "\n".join(self._table(rows, [row.name for row in rows], cells)) + "\n"

    def _mean_cells(self, row: Row, scenes: Sequence[str]) -> dict[str, str]:
        """Return each figure's mean over the scenes that have it; for a scene it is the mean, or best, of its seeds."""
        measured = [seeds for scene in scenes if (seeds := self.measured(scene, row))]
        failed = sum(bool(self._failures(scene, row)) for scene in scenes)
        cells = {"scenes": str(len(measured)), "state": f"{failed} failed" if failed else ""}
        for column in COLUMNS:
            found = [(column.best or mean)(values) for seeds in measured if (values := column.values(seeds))]
            if found:
                number = f" ({len(found)})" if len(found) < len(measured) else ""
                cells[column.figure] = f"{mean(found):.{column.digits}f}{number}"
        return cells

    def _table(
        self, rows: Sequence[Row], names: Sequence[str], cells: Mapping[str, Mapping[str, str]]
    ) -> Iterator[str]:
        """Yield the lines of a table with the columns that have a figure; ``cells`` are by row and column."""
        shown = [key for key in HEADINGS if key in self.columns and any(cells[row.name].get(key) for row in rows)]
        paper = ["in the paper"] if any(row.paper for row in rows) else []
        body = [
            [name, *(cells[row.name].get(key, "") for key in shown), *(_cited(row.paper) for _ in paper)]
            for name, row in zip(names, rows, strict=True)
        ]
        yield from _aligned([["", *(HEADINGS[key] for key in shown), *paper], *body])

    def measured(self, scene: str, row: Row) -> list[Result]:
        """Return the results of a row that have figures, seed by seed."""
        return [result for result in self._tried(scene, row) if not result.failed]

    def _tried(self, scene: str, row: Row) -> list[Result]:
        """Return the results of a row, and its failures."""
        name = self.rows.lift_of(row).measured_as
        return [result for result in self.results if (result.scene, result.row) == (scene, name)]

    def _failures(self, scene: str, row: Row) -> str:
        """Return why seeds of a row have no figures; "" if all were measured."""
        reasons: dict[str, list[int]] = {}
        for result in self._tried(scene, row):
            if result.failed:
                reasons.setdefault(result.failed, []).append(result.seed)
        # The default seed is not named.
        named = {why: f" (seed {', '.join(map(str, s))})" if any(s) else "" for why, s in reasons.items()}
        return "; ".join(f"failed{seeds}: {why}" for why, seeds in named.items())


def _cell(seeds: Sequence[Result], column: Column) -> str:
    """Return a figure's mean and spread as text; "" if nothing was measured."""
    values = column.values(seeds)
    if not values:
        return ""
    text = f"{(column.best or mean)(values):.{column.digits}f}"
    return f"{text} ± {stdev(values):.{column.digits}f}" if len(values) > 1 and not column.best else text


def _cited(paper: Cited | None) -> str:
    """Return the figures that the paper gives, such as "71.2 / 57.8 / 36.6 dB (Replica)"."""
    if paper is None:
        return ""
    shares = [f"{value:.1f}" if value is not None else "-" for value in (paper.miou, paper.pq)]
    psnr = [] if paper.psnr is None else [f"{paper.psnr:.1f} dB"]
    return f"{paper.note or ' / '.join([*shares, *psnr])} ({paper.dataset})"


def _aligned(rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """The table's lines, the first column flush left and figures flush right. A reason may be wider than its column."""
    rows = [[markdown_cell(cell) for cell in row] for row in rows]
    widths = [max(3, *(min(len(row[column]), _WIDEST) for row in rows)) for column in range(len(rows[0]))]
    rule = ["-" * widths[0], *("-" * (width - 1) + ":" for width in widths[1:])]
    for row in [rows[0], rule, *rows[1:]]:
        cells = zip(row, widths, strict=True)
        yield f"| {' | '.join(c.rjust(w) if column else c.ljust(w) for column, (c, w) in enumerate(cells))} |"
