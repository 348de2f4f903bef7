"""``bench masks``: which pairs a folder holds, what is read of them, and how runs are compared."""

import json
import shutil
from pathlib import Path

import pytest

from research.bench_masks import differences
from research.command_line import main
from tests.commands import exit_code
from tests.tiny_scene import write_tiny_scene


def test_bench_masks_compares_each_scene_and_masks_with_an_earlier_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene, file = tmp_path / "pairs/tiny/scene", tmp_path / "run.json"
    write_tiny_scene(scene, frames=6, size=(96, 72))
    for name in ("good", "other"):
        own = scene.parent / name
        own.mkdir()
        shutil.copytree(scene / "panoptic", own / "panoptic")
        table = json.loads((scene / "panoptic.json").read_text())
        for one in table["annotations"]:
            for segment in one["segments_info"]:
                if name == "other" and segment["category_id"] == 5:
                    segment["category_id"] = 3  # the chair is a cabinet in all views
        (own / "panoptic.json").write_text(json.dumps(table))
    asked = ["bench", "masks", str(tmp_path / "pairs"), "--sizes", "96"]
    assert main([*asked, "--json", str(file)]) == 0
    run = json.loads(file.read_text())
    assert set(run) == {"tiny good 96", "tiny other 96"}
    good, other = run["tiny good 96"], run["tiny other 96"]
    assert good[0] > 90 and good[1] > 90 and other[0] < good[0] - 20
    run["tiny good 96"] = [good[0] - 1, good[1] + 2]
    file.write_text(json.dumps(run))
    capsys.readouterr()
    assert main([*asked, "--only", "good", "--against", str(file)]) == 0
    assert "| tiny good | " in (said := capsys.readouterr().out) and "| +1.0 ± 0.0 | -2.0 ± 0.0 |" in said
    assert exit_code(main, "bench", "masks", str(tmp_path / "pairs"), "--only", "nothing") == 2


def test_bench_masks_lists_the_largest_loss_first() -> None:
    before = {"a x 160": (50.0, 40.0), "a x 200": (50.0, 40.0), "b x 160": (30.0, 20.0), "b x 200": (30.0, 20.0)}
    run = {"a x 160": (49.0, 41.0), "a x 200": (47.0, 41.0), "b x 160": (33.0, 20.0), "b x 200": (33.0, 20.0)}
    _, worst, best, mean = differences({**run, "b x 200": (33.0, 20.0)}, before)
    assert worst == "| a x | 48.0 / 41.0 | -2.0 ± 1.0 | +1.0 ± 0.0 |"
    assert best.startswith("| b x | 33.0 / 20.0 | +3.0")
    assert mean == "| mean of 2 | 40.5 / 30.5 | +0.5 ± 1.8 | +0.5 ± 0.4 |"
