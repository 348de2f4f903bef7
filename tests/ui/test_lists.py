"""Searching and sorting the lists."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from plgs.ui.result_panel import places_of, shown_rows

ROWS = [
    SimpleNamespace(name="chair 10", points=5, score=0.2),
    SimpleNamespace(name="chair 2", points=50, score=0.9),
    SimpleNamespace(name="Bin 1", points=20, score=0.5),
    SimpleNamespace(name="wall", points=900, score=0.0),
]


def test_all_words_are_searched_for_ignoring_case() -> None:
    names = [row.name for row in ROWS]
    assert shown_rows(names, "", 8) == [8, 8, 8, 8]
    assert shown_rows(names, "CHAIR", 8) == [8, 8, 0, 0]
    assert shown_rows(names, " 1 chair", 8) == [8, 0, 0, 0]
    assert shown_rows(names, "lamp", 8) == [0, 0, 0, 0]


@pytest.mark.parametrize(
    ("order", "names"),
    [
        ("NAME", ["Bin 1", "chair 2", "chair 10", "wall"]),
        ("COUNT", ["wall", "chair 2", "Bin 1", "chair 10"]),
        ("SCORE", ["chair 2", "Bin 1", "chair 10", "wall"]),
    ],
)
def test_the_list_can_be_sorted(order: str, names: list[str]) -> None:
    places = places_of(ROWS, order)
    assert [row.name for _, row in sorted(zip(places, ROWS, strict=True), key=lambda pair: pair[0])] == names
