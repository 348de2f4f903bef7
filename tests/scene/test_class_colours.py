"""Classes are told apart by their colours, and keep them from scene to scene."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from engine.json_file import to_text
from engine.posed.classes import LARGEST_CLASS_ID, PALETTE, ClassLabel
from engine.records import to_json
from engine.scene import list_classes, open_scene
from engine.scene.class_choice import ClassChoice, ClassRow
from engine.scene.class_map import class_map, coloured
from engine.scene.class_tables import known_table
from engine.scene.report import write_class_list
from engine.scene_source import SceneSource
from tests.posed.test_classes import nearest_pair
from tests.scene.test_class_choice import scene_with

Colour = tuple[int, int, int]


def colours_of(*names: str) -> dict[str, Colour]:
    table = coloured(ClassLabel(number, name, True) for number, name in enumerate(names, start=1))
    return {each.name: each.colour for each in table.categories}


def of_table(name: str) -> list[Colour]:
    return [each.colour for each in class_map(known_table(name).labels, None, Path("masks"), False).classes.categories]


@pytest.mark.parametrize(
    ("name", "apart"),
    [("reduced", 17.6), ("nyu40", 15.6), ("replica", 7), ("coco", 6.3), ("ade20k", 5.9), ("scannet200", 7.6)],
)
def test_classes_of_public_tables_are_far_apart(name: str, apart: float) -> None:
    """By CIEDE2000. Of the sample's 18 classes, the nearest two were 5.2 apart by their old colours."""
    assert nearest_pair(of_table(name))[0] > apart


def test_made_up_classes_are_far_apart_too() -> None:
    for scene in range(5):
        colours = colours_of(*(f"part {scene} {number}" for number in range(40)))
        assert nearest_pair(list(colours.values()))[0] > 9.3
    many = colours_of(*(f"part {number}" for number in range(len(PALETTE) + 1)))
    assert len({*many.values()}) == len(PALETTE)


def test_as_many_classes_as_ids_take_seconds() -> None:
    """They took minutes."""
    began = time.process_time()
    table = coloured(ClassLabel(number, f"part {number}", True) for number in range(1, LARGEST_CLASS_ID + 1))
    assert [table[number].id for number in table.ids] == [*table.ids]
    assert time.process_time() - began < 10.0


def test_a_class_keeps_its_colour() -> None:
    """Whatever its number is, which classes are beside it, and how it is written."""
    one = colours_of("wall", "floor", "books", "TV-stand", "flux capacitor")
    other = colours_of("flux capacitor", "books", "road, route", "Floor", "tv stand")
    assert one["books"] == other["books"] and one["TV-stand"] == other["tv stand"] and one["floor"] == other["Floor"]
    assert one["flux capacitor"] == other["flux capacitor"] and other["road, route"] == colours_of("road")["road"]


def test_one_of_two_unknown_classes_gives_way_however_they_are_numbered() -> None:
    alone = {name: colours_of(name)[name] for name in (f"part {number}" for number in range(60))}
    one, other = next((a, b) for a in alone for b in alone if a < b and alone[a] == alone[b])
    both = colours_of(other, one)
    assert both == colours_of(one, other) and both[one] == alone[one] != both[other]


def test_colours_of_ones_own(tmp_path: Path) -> None:
    """In the masks' table, and in classes.toml, which wins; the panel's list keeps them."""
    rows = '[[class]]\nname = "chair"\ncolour = "#0A0b0C"\n[[class]]\nid = 3\ninto = "box"\ncolour = "#ffffff"\n'
    folder = scene_with(tmp_path, rows)
    listed = list_classes(SceneSource(scene=folder))
    for _ in range(2):
        classes = open_scene(folder).classes
        assert (classes[5].colour, classes[3].colour) == ((10, 11, 12), (255, 255, 255))
        assert classes[3].name == "box" and classes[1].colour == (200, 190, 170)
        (tmp_path / "edited.json").write_text(to_text(to_json(listed)))
        write_class_list(SceneSource(scene=folder), tmp_path / "edited.json")
    reduced = ClassChoice(table="coco", to_reduced=True, rows=(ClassRow(id=57, colour="#010203"),))
    known = class_map(None, reduced, Path("masks"), objects=False)
    assert known.classes[known.class_of[57]].colour == (1, 2, 3)


@pytest.mark.parametrize("colour", ["red", "#12345", "#1234567", "0a0b0c"])
def test_what_is_no_colour_is_refused(colour: str) -> None:
    with pytest.raises(ValueError, match="not a colour"):
        ClassRow(id=1, colour=colour)
