"""Results of lifts: read from a finished one, and written to results.csv."""

import csv
from dataclasses import replace

from engine.job import Event
from engine.metrics.report import INPUT_MASKS, LIFTED
from research import results
from tests.research.experiments.made_up import KITCHEN, OFFICE


def test_other_programs_read_the_csv_of_results() -> None:
    rows = list(csv.DictReader(results.csv_text(OFFICE).splitlines()))
    assert [row["row"] for row in rows] == ["ours", "input masks", "theirs"]
    assert (rows[0]["miou"], rows[0]["steps"], rows[1]["psnr"]) == ("0.8", "500", "")


def test_no_cell_of_the_results_csv_is_a_formula() -> None:
    text = results.csv_text([replace(KITCHEN, scene='=HYPERLINK("x")')])
    assert next(csv.DictReader(text.splitlines()))["scene"] == '\'=HYPERLINK("x")'


RENDERED = {"psnr": 20.0, "psnr_fitted": 22.0, "ssim": 0.5, "depth_error_m": 0.02}


def test_scores_of_both_modes_make_one_row() -> None:
    followed = {"pq_frame": 0.25, "id_changes": 3}
    rows = results.scores_by_method(
        [
            {"name": INPUT_MASKS, "mode": "strict", "miou": 0.1, "miou_true": 0.15, "pq": 0.2, **followed},
            {"name": INPUT_MASKS, "mode": "pl_compat", "miou": 0.3, "miou_true": 0.35, "pq": 0.4, "psnr": None},
            {"name": LIFTED, "mode": "strict", "miou": 0.5, "pq": 0.6, **RENDERED},
            {"name": LIFTED, "mode": "pl_compat", "miou": 0.7, "pq": 0.8, **RENDERED},
        ]
    )
    assert rows == {
        INPUT_MASKS: results.Figures(0.1, 0.15, 0.2, 0.3, 0.35, 0.4, 0.25, 3.0),
        LIFTED: results.Figures(0.5, None, 0.6, 0.7, None, 0.8, None, None, 20.0, 22.0, 0.5, 0.02),
    }


def test_the_time_of_a_lift_adds_up_all_its_runs() -> None:
    """One run was killed while it trained, the next one finished, a third baked more frames."""
    written = (
        (100.0, "hello", {}),
        (101.0, "stage", {"name": "train"}),
        (130.0, "progress", {"stage": "train"}),
        (500.0, "hello", {}),
        (502.0, "stage", {"name": "train"}),
        (540.0, "stage", {"name": "bake"}),
        (560.0, "stage", {"name": "evaluate"}),
        (590.0, "done", {"state": "finished"}),
        (900.0, "hello", {"task": "bake"}),
        (950.0, "done", {"state": "finished"}),
    )
    events = [Event(seq, *each) for seq, each in enumerate(written, start=1)]
    assert results.lifting_seconds(events) == 30.0 + 40.0
    assert results.lifting_seconds([]) is None


def test_results_contain_memory_and_frames_per_second() -> None:
    first, last = ({"name": "run", "values": values} for values in ({"peak_bytes": 3e9}, {"peak_bytes": 1e9, "fps": 2}))
    events = [Event(1, 0.0, "metric", first), Event(2, 1.0, "metric", {"name": "loss", "values": {}})]
    assert results.run_figures([*events, Event(3, 2.0, "metric", last)]) == {"peak_bytes": 3e9, "fps": 2.0}
    assert results.run_figures([]) == {"peak_bytes": None, "fps": None}
