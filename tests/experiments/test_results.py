"""results.json, written and read again."""

from __future__ import annotations

from pathlib import Path

import pytest

from engine.experiments import read_results
from engine.experiments.results import results_text
from engine.job import JobError
from tests.experiments.made_up import KITCHEN, OFFICE


def test_what_was_written_is_read(tmp_path: Path) -> None:
    file = tmp_path / "results.json"
    file.write_text(results_text([OFFICE, KITCHEN]))
    assert read_results(file) == (OFFICE, KITCHEN)


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (None, "cannot be read"),
        ("not JSON", "is not JSON"),
        ('{"format": 2, "results": []}', "has format 2"),
        ('{"format": 1, "tables": []}', "is damaged"),
        ('{"format": 1, "results": [5]}', "is damaged"),
        ('{"format": 1, "results": [{"scene": "a"}]}', "is damaged"),
        (results_text([KITCHEN]).replace('"lifted"', '"guessed"'), "unknown method"),
        (results_text([]), "holds no results"),
    ],
)
def test_another_file_is_refused(tmp_path: Path, content: str | None, told: str) -> None:
    file = tmp_path / "results.json"
    if content is not None:
        file.write_text(content)
    with pytest.raises(JobError, match=told):
        read_results(file)
