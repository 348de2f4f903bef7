"""The table of a metrics.json that may be anybody's."""

from __future__ import annotations

from engine.job.report import metrics_text


def test_numbers_that_nobody_measured_are_a_dash() -> None:
    """JSON's integers have no end: one of them ended the engine and Blender's script with a traceback."""
    for number in (10**400, -(10**400), 1e308, float("nan"), float("inf"), "7", None, []):
        table = {"name": "lifted", "mode": "strict", "miou": number, "psnr": number, "pq": 0.5}
        table["per_class"] = [{"name": "wall", "iou": number, "tp": number, "fp": 3}]
        lines = metrics_text({"tables": [table]}, per_class=True).splitlines()
        assert lines[1].split() == ["lifted", "strict", "-", "-", "50.0", *"-" * 10]
        assert lines[-1].split() == ["wall", "-", "-", "-", "-", "-", "3", "-"]
