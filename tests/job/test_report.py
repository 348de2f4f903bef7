"""The table of a metrics.json that may be anybody's."""

from __future__ import annotations

from engine.job.report import metrics_text, not_shown


def test_numbers_that_were_not_measured_are_a_dash() -> None:
    """JSON's integers have no end: one of them ended the engine and Blender's script with a traceback."""
    for number in (10**400, -(10**400), 1e308, float("nan"), float("inf"), "7", None, []):
        table = {"name": "lifted", "mode": "strict", "miou": number, "psnr": number, "pq": 0.5}
        table["per_class"] = [{"name": "wall", "iou": number, "tp": number, "fp": 3}]
        lines = metrics_text({"tables": [table]}, per_class=True).splitlines()
        assert lines[1].split() == ["lifted", "strict", "-", "-", "50.0", *"-" * 10]
        assert lines[-1].split() == ["wall", "-", "-", "-", "-", "-", "3", "-"]


def test_what_the_lift_does_not_show_is_reported() -> None:
    sink = {"name": "sink", "whole_class": True, "views": 4, "shown_as": "countertop", "frame": "0012"}
    chair = {"name": "chair", "whole_class": False, "views": 3, "shown_as": "", "frame": "0031"}
    metrics = {"tables": [{"name": "lifted"}], "masks_as_judges": {"not_shown": [sink, chair, "no entry"]}}
    assert not_shown(metrics) == [
        ("sink: 4 near views, shown as countertop", "0012"),
        ("one chair: 3 near views", "0031"),
    ]
    assert metrics_text(metrics).splitlines()[-2:] == [
        "Not shown: sink: 4 near views, shown as countertop (see frame 0012)",
        "Not shown: one chair: 3 near views (see frame 0031)",
    ]
    for broken in ({}, {"masks_as_judges": 3}, {"masks_as_judges": {"not_shown": 7}}):
        assert not_shown(broken) == []
