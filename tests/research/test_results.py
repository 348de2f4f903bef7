"""results.json, written and read again, and results.csv."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import pytest

from research.results import csv_text, read_results, results_text
from tests.raises_key import raises_key
from tests.research.experiments.made_up import KITCHEN, OFFICE


def test_what_was_written_is_read(tmp_path: Path) -> None:
    file = tmp_path / "results.json"
    file.write_text(results_text([*OFFICE, KITCHEN]))
    assert read_results(file) == (*OFFICE, KITCHEN)


def test_other_programs_read_the_csv() -> None:
    rows = list(csv.DictReader(csv_text(OFFICE).splitlines()))
    assert [row["row"] for row in rows] == ["ours", "input masks", "theirs"]
    assert (rows[0]["miou"], rows[0]["steps"], rows[1]["psnr"]) == ("0.8", "500", "")


def test_no_csv_cell_is_a_formula() -> None:
    text = csv_text([replace(KITCHEN, scene='=HYPERLINK("x")')])
    assert next(csv.DictReader(text.splitlines()))["scene"] == '\'=HYPERLINK("x")'


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (None, "unreadable"),
        ("not JSON", "json-broken"),
        ('{"format": 1, "results": []}', "other-format"),
        ('{"format": 2, "tables": []}', "results-damaged"),
        ('{"format": 2, "results": [5]}', "results-damaged"),
        ('{"format": 2, "results": [{"scene": "a"}]}', "results-damaged"),
        (results_text([]), "results-empty"),
    ],
)
def test_another_file_is_refused(tmp_path: Path, content: str | None, told: str) -> None:
    file = tmp_path / "results.json"
    if content is not None:
        file.write_text(content)
    with raises_key(told):
        read_results(file)
