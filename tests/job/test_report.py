"""The table of a metrics.json that may be anybody's."""

from __future__ import annotations

from engine.job.report import classes_text, tables_text


def test_numbers_that_nobody_measured_are_a_dash() -> None:
    """JSON's integers have no end: one of them ended the engine and Blender's script with a traceback."""
    for number in (10**400, -(10**400), 1e308, float("nan"), float("inf"), "7", None, []):
        table = {"name": "lifted", "mode": "strict", "miou": number, "psnr": number, "pq": 0.5}
        line = tables_text([table]).splitlines()[1]
        assert line.split() == ["lifted", "strict", "-", "50.0", *"-" * 10]
        row = classes_text([{**table, "per_class": [{"name": "wall", "iou": number, "tp": number, "fp": 3}]}])
        assert row.splitlines()[1].split() == ["wall", "-", "-", "-", "-", "-", "3", "-"]
