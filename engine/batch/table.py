"""The table at the end of a batch: one row per scene, and the means."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from ..gates import markdown_cell, table_cell
from ..job import write_atomically
from .plan import Row

COLUMNS = {
    "miou": "mIoU %", "miou_true": "true %", "pq": "PQ %", "sq": "SQ %", "rq": "RQ %",
    "psnr": "PSNR dB", "ssim": "SSIM", "depth_error_m": "depth cm",
}  # fmt: skip
_FACTORS = {"miou": 100.0, "miou_true": 100.0, "pq": 100.0, "sq": 100.0, "rq": 100.0, "depth_error_m": 100.0}


def write_tables(folder: Path, rows: Sequence[Row]) -> str:
    """Write table.csv, with the exact figures, and table.md, whose text is returned. Raises OSError."""
    text = markdown(rows)
    write_atomically(folder / "table.csv", _csv(rows))
    write_atomically(folder / "table.md", text)
    return text


def _csv(rows: Sequence[Row]) -> str:
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(["scene", "state", "seconds", *COLUMNS, "code", "reason"])
    for row in rows:
        figures = [_figure(row, key) for key in COLUMNS]
        cells = [row.scene, row.state, round(row.seconds, 1), *figures, row.code, row.reason]
        writer.writerow([table_cell(cell) for cell in cells])
    writer.writerow(["mean", "", *_means(rows), "", ""])
    return file.getvalue()


def markdown(rows: Sequence[Row]) -> str:
    """The table in Markdown: shares in per cent, lengths in cm, and a dash where a scene has no ground truth."""
    lines = [["scene", "state", "minutes", *COLUMNS.values(), "reason"]]
    for row in rows:
        figures = [_shown(key, _figure(row, key)) for key in COLUMNS]
        lines.append([row.scene, row.state, f"{row.seconds / 60:.1f}", *figures, row.reason])
    seconds, *means = _means(rows)
    shown = [_shown(key, mean) for key, mean in zip(COLUMNS, means, strict=True)]
    lines.append(["**mean**", "", "-" if seconds is None else f"{seconds / 60:.1f}", *shown, ""])
    cells = [[markdown_cell(cell) for cell in line] for line in lines]
    body = ["| " + " | ".join(line) + " |" for line in cells]
    return "\n".join([body[0], "|" + "---|" * len(lines[0]), *body[1:], *_codes(rows), ""])


def _codes(rows: Sequence[Row]) -> list[str]:
    """A line where different versions of the code lifted the scenes."""
    codes = Counter(row.code or "unknown" for row in rows if row.state == "done")
    counted = ", ".join(f"{code} ({count})" for code, count in codes.most_common())
    return ["", f"Lifted by different versions of the code: {counted}."] if len(codes) > 1 else []


def _figure(row: Row, key: str) -> float | None:
    value = row.metrics.get(key)
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def _means(rows: Sequence[Row]) -> list[float | None]:
    """The means over the scenes that are done and have the figure."""
    done = [row for row in rows if row.state == "done"]
    seconds: list[float | None] = [row.seconds for row in done]
    columns = [seconds, *([_figure(row, key) for row in done] for key in COLUMNS)]
    return [_mean([value for value in column if value is not None]) for column in columns]


def _mean(values: Sequence[float]) -> float | None:
    return sum(values) / len(values) if values else None


def _shown(key: str, value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value * _FACTORS.get(key, 1.0):.{3 if key == 'ssim' else 1}f}"
