"""metrics.json as text for a terminal. Standard library only."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

_SHARES = (("miou", "mIoU"), ("pq", "PQ"), ("sq", "SQ"), ("rq", "RQ"))


def format_table(metrics: Mapping[str, object]) -> str:
    """One line a method and mode, percent with one decimal; PSNR in decibels, SSIM in [0, 1].

    ``metrics`` is the content of metrics.json. Without tables the text says why there are none.
    """
    tables = metrics.get("tables")
    if not isinstance(tables, list) or not tables:
        return "No metrics: the held-out frames have no ground truth."
    rows = [["percent; PSNR in dB", "mode", *(heading for _, heading in _SHARES), "PSNR", "SSIM"]]
    for table in tables:
        shares = [_number(table.get(key), 100.0, 1) for key, _ in _SHARES]
        pictures = [_number(table.get("psnr"), 1.0, 1), _number(table.get("ssim"), 1.0, 3)]
        rows.append([str(table.get("name")), str(table.get("mode") or "-"), *shares, *pictures])
    return _aligned(rows, left=2)


def format_classes(metrics: Mapping[str, object], method: str = "lifted", mode: str = "strict") -> str:
    """The per-class rows of one method in one mode, percent with one decimal; empty when there are none."""
    tables = metrics.get("tables")
    for table in tables if isinstance(tables, list) else []:
        if table.get("name") == method and table.get("mode") == mode and table.get("per_class"):
            rows = [[f"{method}, {mode}, percent", "IoU", *(heading for _, heading in _SHARES[1:]), "TP", "FP", "FN"]]
            for row in table["per_class"]:
                shares = [_number(row.get(key), 100.0, 1) for key in ("iou", "pq", "sq", "rq")]
                rows.append([str(row["name"]), *shares, *(str(row[key]) for key in ("tp", "fp", "fn"))])
            return _aligned(rows, left=1)
    return ""


def _number(value: object, factor: float, digits: int) -> str:
    return f"{value * factor:.{digits}f}" if isinstance(value, (int, float)) else "-"


def _aligned(rows: Sequence[Sequence[str]], left: int) -> str:
    """Columns two spaces apart: the first ``left`` ones flush left, the others flush right."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = (
        "  ".join(
            cell.ljust(width) if column < left else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        for row in rows
    )
    return "\n".join(line.rstrip() for line in lines)
