"""The figures of all scenes as one table in Markdown."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from ..metrics import LIFTED
from .figures import Figures, SceneResult


@dataclass(frozen=True)
class Column:
    """How a figure (a field of Figures) is shown: times ``factor``, with so many digits after the point."""

    figure: str
    heading: str
    factor: float
    digits: int


COLUMNS = (
    Column("miou", "mIoU % `strict`", 100.0, 1),
    Column("pq", "PQ % `strict`", 100.0, 1),
    Column("miou_pl_compat", "mIoU % `pl_compat`", 100.0, 1),
    Column("pq_pl_compat", "PQ % `pl_compat`", 100.0, 1),
    Column("psnr", "PSNR dB", 1.0, 2),
    Column("psnr_fitted", "PSNR dB, colours fitted", 1.0, 2),
    Column("ssim", "SSIM", 1.0, 3),
    Column("depth_error_m", "depth error cm", 100.0, 1),
    Column("seconds", "lift s", 1.0, 0),
)


def markdown_table(results: Sequence[SceneResult], earlier: Sequence[SceneResult] = ()) -> str:
    """A row for each scene and method. With ``earlier`` results the lifted model's figures are "before -> after" where
    these have the same scene and preset.
    """
    heading = ["scene", "method", *(column.heading for column in COLUMNS)]
    rows = [row for result in results for row in _rows(result, _before(result, earlier))]
    widths = [max(len(row[place]) for row in [heading, *rows]) for place in range(len(heading))]
    rule = ["-" * widths[0], "-" * widths[1], *("-" * (width - 1) + ":" for width in widths[2:])]
    return "\n".join(_line(row, widths) for row in [heading, rule, *rows]) + "\n"


def _before(result: SceneResult, earlier: Sequence[SceneResult]) -> Figures | None:
    """The lifted model's figures in the earlier results."""
    same = (each for each in earlier if (each.scene, each.preset) == (result.scene, result.preset))
    return next((each.rows[LIFTED] for each in same if LIFTED in each.rows), None)


def _rows(result: SceneResult, before: Figures | None) -> Iterator[list[str]]:
    """The scene's name stands in its first row, the preset behind the method that it belongs to."""
    name = result.scene
    for method, figures in result.rows.items():
        is_lifted = method == LIFTED
        title = f"{method}, `{result.preset}`" if is_lifted else method
        yield [name, title, *_cells(figures, before if is_lifted else None)]
        name = ""


def _cells(figures: Figures, before: Figures | None) -> Iterator[str]:
    for column in COLUMNS:
        now = _cell(figures, column)
        then = "" if before is None else _cell(before, column)
        is_compared = before is not None and (then or now)
        yield f"{then or '-'} -> {now or '-'}" if is_compared else now


def _cell(figures: Figures, column: Column) -> str:
    """Empty where nothing was measured."""
    value: float | None = getattr(figures, column.figure)
    return "" if value is None else f"{value * column.factor:.{column.digits}f}"


def _line(cells: Sequence[str], widths: Sequence[int]) -> str:
    """The first two columns flush left, figures flush right."""
    sized = enumerate(zip(cells, widths, strict=True))
    padded = [cell.ljust(width) if place < 2 else cell.rjust(width) for place, (cell, width) in sized]
    return f"| {' | '.join(padded)} |"
