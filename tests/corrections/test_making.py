"""A class is the one that is named, never the first of several."""

from __future__ import annotations

import numpy as np
import pytest

from engine.corrections.making import class_of
from engine.errors import PlgsError
from engine.posed.classes import Category, ClassTable

_NAMES = {3: "Chair", 7: "chair", 8: "desk", 9: "lamp", 10: "rug", 12: "11", 13: "12", 14: "mat", 15: "mat"}
CLASSES = ClassTable(tuple(Category(number, name, True, (1, 2, 3)) for number, name in _NAMES.items()))


@pytest.mark.parametrize(
    ("text", "found"),
    [("chair", 7), ("Chair", 3), (" desk ", 8), ("DESK", 8), ("7", 7), ("lamp", 9), ("10", 10), ("11", 12), ("12", 13),
     ("12 11", 12), ("14", 14), ("15 mat", 15), (12, 12), (np.int64(3), 3)],
)  # fmt: skip
def test_a_class_by_its_name_or_number(text: int | str, found: int) -> None:
    assert class_of(CLASSES, text) == found


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("CHAIR", "may be the class 3 Chair or 7 chair: "),
        ("mat", "may be the class 14 mat or 15 mat: "),
        ("sofa", "there is no class sofa.*The classes are 3 Chair, 7 chair, 8 desk"),
        ("99", "there is no class 99"),
    ],
)
def test_a_class_is_not_guessed(text: str, told: str) -> None:
    with pytest.raises(PlgsError, match=told):
        class_of(CLASSES, text)
