from __future__ import annotations

import pytest

from engine.scene import Category, ClassTable, distinct_colour


def category(class_id: int, is_thing: bool = False) -> Category:
    return Category(class_id, f"class {class_id}", is_thing, (1, 2, 3))


def test_a_table_finds_its_categories_by_id() -> None:
    table = ClassTable((category(2), category(7, True)))
    assert table.ids == (2, 7) and table.thing_ids == {7} and len(table) == 2
    assert table[7].name == "class 7" and 7 in table and 3 not in table
    with pytest.raises(KeyError):
        table[3]


@pytest.mark.parametrize("ids", [(0, 1), (2, 1), (1, 1), (-1,)])
def test_ids_are_unique_ascending_and_above_void(ids: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="ascending"):
        ClassTable(tuple(category(class_id) for class_id in ids))


def test_colours_are_distinct_and_bytes() -> None:
    colours = [distinct_colour(index) for index in range(60)]
    assert len({*colours}) == 60
    assert all(0 <= part <= 255 for colour in colours for part in colour)
