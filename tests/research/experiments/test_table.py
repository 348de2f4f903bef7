"""The page of an experiment: tables with the paper's figures and seeds."""

from collections.abc import Sequence
from dataclasses import replace

from research.experiments.table import Tables
from research.results import Figures, Result, this_engine
from tests.research.experiments.made_up import KITCHEN, OFFICE, ROWS


def cells(table: str) -> list[list[str]]:
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines() if line[:1] == "|"]


def of_table(name: str, results: Sequence[Result]) -> list[list[str]]:
    rows = [row for row in ROWS.rows if row.table == name]
    return cells("\n".join(Tables(ROWS, ROWS.rows, tuple(results)).lines(results[0].scene, rows)))


def test_the_results_table_shows_the_papers_figures() -> None:
    heading, rule, *rows = of_table("systems", OFFICE)
    assert heading == [
        "", "mIoU %", "mIoU % true classes", "PQ-scene %", "mIoU % `pl_compat`", "mIoU % `pl_compat`, true classes",
        "PQ-scene % `pl_compat`", "per-frame PQ %",
        "id changes per object", "PSNR dB", "PSNR dB, colours fitted", "SSIM", "depth error cm", "steps", "lift s",
        "peak GB", "panoptic frames/s", "in the paper",
    ]  # fmt: skip
    assert all(set(cell) <= set("-:") for cell in rule)
    nothing = [""] * 8
    assert rows == [
        ["ours", "80.0", "85.0", "70.0", "81.0", "86.0", "71.0", "75.0", "0.12", "27.00", "28.50", "0.875", "2.3",
         "500", "162", "1.3", "3.2", ""],
        ["input masks", "50.0", "55.0", "25.0", "51.0", "56.0", "26.0", "40.0", "3.50", *nothing, ""],
        ["theirs", "60.0", "", "50.0", *[""] * 9, "500", *[""] * 3, "71.2 / 57.8 / 36.6 dB (Replica)"],
        ["elsewhere (cited)", *[""] * 16, "- / 62.3 (ScanNet)"],
    ]  # fmt: skip


def test_results_of_several_seeds_show_their_spread() -> None:
    seeds = ((0, 0.5), (1, 0.6))
    results = [replace(OFFICE[2], seed=seed, figures=OFFICE[2].figures._replace(pq=pq)) for seed, pq in seeds]
    assert of_table("parts", results)[2][:3] == ["all of it", "60.0 ± 0.0", "55.0 ± 7.1"]


def test_the_results_have_one_section_for_each_scene() -> None:
    text = Tables(ROWS, ROWS.rows, (*OFFICE, KITCHEN)).markdown()
    assert [line for line in text.splitlines() if line[:1] in ("#", "*")] == [
        "### office", "**Systems**", "### kitchen", "**Systems**", "### Means: over the scenes", "**Systems**",
    ]  # fmt: skip
    _, office, kitchen, _ = text.split("###")
    assert "elsewhere (cited)" in office and "elsewhere" not in kitchen, "once is enough"
    assert len({len(line) for line in office.splitlines() if line[:1] == "|"}) == 1


def test_results_lifted_by_another_engine_version_are_marked() -> None:
    own = replace(OFFICE[0], row="without depth")
    results = (OFFICE[0], OFFICE[1], replace(OFFICE[2], engine_version="0.0.9"), own)
    text = Tables(ROWS, ROWS.rows, results).markdown()
    systems, parts = text.split("**Its parts**")
    assert [row[0] for row in cells(systems)[2:]] == ["ours", "input masks", "theirs †", "elsewhere (cited)"]
    assert [row[0] for row in cells(parts)[2:]] == ["all of it †", "without depth"]
    for table in (systems, parts):
        assert table.rstrip().splitlines()[-1] == f"† Lifted by the engine 0.0.9, not by this one, {this_engine()}."
    assert "†" not in Tables(ROWS, ROWS.rows, OFFICE).markdown()


def test_means_cover_only_scenes_that_have_the_figure() -> None:
    seeds = [replace(KITCHEN, seed=seed, figures=Figures(miou=miou, psnr=17.0)) for seed, miou in ((0, 0.3), (1, 0.5))]
    broken = [Result("hall", row, "preview", 0, 0, this_engine(), failed="no frames") for row in ("ours", "theirs")]
    text = Tables(ROWS, ROWS.rows, (*OFFICE, *seeds, *broken)).markdown()
    heading, _, *rows = cells(text.split("### Means")[1])
    ours, masks, theirs = (dict(zip(heading, row, strict=True)) for row in rows)
    assert (ours["scenes"], ours["mIoU %"], ours["PSNR dB"]) == ("2", "60.0", "22.00"), "seeds first, then scenes"
    assert ours["PQ-scene %"] == "70.0 (1)" and ours["state"] == theirs["state"] == "1 failed"
    assert (masks["scenes"], masks["mIoU %"], masks["state"]) == ("1", "50.0", "")
    hall = cells(text.split("### hall")[1].split("###")[0])
    assert hall[0][:2] == ["", "state"] and [row[:2] for row in hall[2:]] == [
        ["ours", "failed: no frames"], ["theirs", "failed: no frames"],
    ]  # fmt: skip
