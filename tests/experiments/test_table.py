"""The table in Markdown, alone and against earlier results."""

from __future__ import annotations

from dataclasses import replace

from engine.experiments.figures import Figures, SceneResult
from engine.experiments.table import markdown_table
from engine.metrics import LIFTED
from tests.experiments.made_up import KITCHEN, OFFICE


def cells(table: str) -> list[list[str]]:
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()]


def lifted(result: SceneResult, **figures: float | None) -> SceneResult:
    return replace(result, rows={**result.rows, LIFTED: result.rows[LIFTED]._replace(**figures)})


def test_all_scenes_in_one_table() -> None:
    heading, rule, *rows = cells(markdown_table([OFFICE, KITCHEN]))
    assert heading == [
        "scene", "method", "mIoU % `strict`", "PQ % `strict`", "mIoU % `pl_compat`", "PQ % `pl_compat`", "PSNR dB",
        "PSNR dB, colours fitted", "SSIM", "depth error cm", "lift s",
    ]  # fmt: skip
    assert all(set(cell) <= set("-:") for cell in rule)
    nothing = [""] * 5
    assert rows == [
        ["office", "machine masks", "50.0", "25.0", "51.0", "26.0", *nothing],
        ["", "voxel vote (with test depth)", "75.0", "50.0", "76.0", "51.0", *nothing],
        ["", "lifted, `preview`", "80.0", "70.0", "81.0", "71.0", "27.00", "28.50", "0.875", "2.3", "162"],
        ["kitchen", "lifted, `preview`", "", "", "", "", "17.00", "21.00", "0.600", "5.0", "100"],
    ]


def test_lines_are_as_long_as_one_another() -> None:
    assert len({len(line) for line in markdown_table([OFFICE, KITCHEN], [OFFICE]).splitlines()}) == 1


def test_before_and_after_of_the_lifted_model_only() -> None:
    before = lifted(OFFICE, miou=0.6, seconds=200.0, psnr_fitted=None)
    _, _, masks, vote, row, kitchen = cells(markdown_table([lifted(OFFICE, ssim=None), KITCHEN], [before]))
    assert masks[2] == "50.0" and vote[2] == "75.0"
    assert row[2:] == [
        "60.0 -> 80.0", "70.0 -> 70.0", "81.0 -> 81.0", "71.0 -> 71.0", "27.00 -> 27.00", "- -> 28.50", "0.875 -> -",
        "2.3 -> 2.3", "200 -> 162",
    ]  # fmt: skip
    assert kitchen[6] == "17.00"


def test_figures_that_neither_has_stay_empty() -> None:
    _, _, row = cells(markdown_table([KITCHEN], [KITCHEN]))
    assert row[2:6] == [""] * 4 and row[6] == "17.00 -> 17.00"


def test_another_preset_is_another_lift() -> None:
    _, _, row = cells(markdown_table([KITCHEN], [replace(KITCHEN, preset="standard")]))
    assert row[6] == "17.00"
    earlier = [replace(KITCHEN, preset="standard", rows={LIFTED: Figures(psnr=1.0)}), KITCHEN]
    _, _, row = cells(markdown_table([KITCHEN], earlier))
    assert row[6] == "17.00 -> 17.00"
