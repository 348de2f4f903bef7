"""The classes that a user chooses, and their colours."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from engine.json_file import to_text
from engine.posed.classes import PALETTE, ClassLabel
from engine.records import to_json
from engine.scene import list_classes, open_scene
from engine.scene.class_choice import ClassChoice, ClassRow, class_choice_text, read_class_choice
from engine.scene.class_map import choice_of, class_map, coloured, named_classes
from engine.scene.class_tables import known_table, reduced_by_name
from engine.scene.report import write_class_list
from engine.scene_source import SceneSource
from tests.posed.test_classes import nearest_pair
from tests.raises_key import raises_key
from tests.scene.mask_formats.test_label_images import write_pairs
from tests.scene.refusing import refuses
from tests.tiny_scene import write_tiny_scene

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
def test_colours_of_public_class_tables_are_far_apart(name: str, apart: float) -> None:
    """By CIEDE2000. Of the sample's 18 classes, the nearest two were 5.2 apart by their old colours."""
    assert nearest_pair(of_table(name))[0] > apart


def test_colours_of_users_own_classes_are_far_apart() -> None:
    for scene in range(5):
        colours = colours_of(*(f"part {scene} {number}" for number in range(40)))
        assert nearest_pair(list(colours.values()))[0] > 9.3
    many = colours_of(*(f"part {number}" for number in range(len(PALETTE) + 1)))
    assert len({*many.values()}) == len(PALETTE)


def test_a_class_keeps_its_colour_when_classes_are_added() -> None:
    """Whatever its number is, which classes are beside it, and how it is written."""
    one = colours_of("wall", "floor", "books", "TV-stand", "flux capacitor")
    other = colours_of("flux capacitor", "books", "road, route", "Floor", "tv stand")
    assert one["books"] == other["books"] and one["TV-stand"] == other["tv stand"] and one["floor"] == other["Floor"]
    assert one["flux capacitor"] == other["flux capacitor"] and other["road, route"] == colours_of("road")["road"]


def test_colours_of_clashing_classes_do_not_depend_on_their_numbers() -> None:
    alone = {name: colours_of(name)[name] for name in (f"part {number}" for number in range(60))}
    one, other = next((a, b) for a in alone for b in alone if a < b and alone[a] == alone[b])
    both = colours_of(other, one)
    assert both == colours_of(one, other) and both[one] == alone[one] != both[other]


def test_users_may_choose_the_colours_of_classes(tmp_path: Path) -> None:
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


HERE = Path("masks")


def scene_with(tmp_path: Path, text: str) -> Path:
    folder = write_tiny_scene(tmp_path, frames=3, size=(32, 24))
    (folder / "classes.toml").write_text(text)
    return folder


def classes_of(first: str, *rows: ClassRow, to_reduced: bool = False) -> list[int]:
    """Of three labels, which are called as the first one is, chair and stool."""
    labels = tuple(ClassLabel(number, name, True) for number, name in ((3, first), (7, "chair"), (8, "stool")))
    known = class_map(labels, ClassChoice(rows=rows, to_reduced=to_reduced), HERE, objects=False)
    return [known.class_of[label.id] for label in labels]


def test_class_names_that_differ_only_in_capitals_can_be_joined() -> None:
    assert classes_of("Chair") == [3, 7, 8]
    assert classes_of("Chair", ClassRow(name="Chair", into="chair")) == [7, 7, 8]
    into_chair = ClassRow(name="chair", into="Chair"), ClassRow(name="stool", into="CHAIR")
    assert classes_of("Chair", *into_chair) == [3, 3, 3]
    assert classes_of("Chair", ClassRow(name="stool", into="chair")) == [3, 7, 7]
    for name, into in (("CHAIR", "stool"), ("stool", "CHAIR"), ("chair", "CHAIR")):
        with raises_key("class-twice CHAIR"):
            classes_of("Chair", ClassRow(name=name, into=into))


def test_two_classes_of_the_same_name_can_be_joined() -> None:
    stool, joined = ClassRow(name="stool", into="chair"), ClassRow(id=3, into="chair")
    with raises_key("class-twice chair"):
        classes_of("chair", stool)
    assert classes_of("chair", joined) == [7, 7, 8] and classes_of("chair", stool, joined) == [7, 7, 7]
    assert classes_of("chair", joined, stool, to_reduced=True) == classes_of("chair", stool, to_reduced=True)


def test_class_names_that_differ_only_in_capitals_are_reported(tmp_path: Path) -> None:
    scene = open_scene(scene_with(tmp_path / "a", '[[class]]\nid = 3\nname = "Chair"\n'))
    assert any("classes 3 Chair, 5 chair have names that differ only in capitals" in told for told in scene.warnings)
    scene = open_scene(scene_with(tmp_path / "b", '[[class]]\nid = 3\nname = "chair"\n'))
    assert any("3 chair, 5 chair have the same name" in told and "number" in told for told in scene.warnings)


def test_classes_toml_decides_between_thing_and_stuff(tmp_path: Path) -> None:
    scene = open_scene(scene_with(tmp_path, '[[class]]\nname = "cabinet"\nthing = false\n'))
    assert scene.classes.thing_ids == {5}
    assert not any(one.is_thing for one in scene.frames[0].mask().segments if one.class_id == 3)


def test_the_papers_classes_are_found_by_name(tmp_path: Path) -> None:
    scene = open_scene(scene_with(tmp_path, 'to = "reduced"\n'))
    assert len(scene.classes) == 21 and scene.classes[14].name == "refrigerator"
    assert reduced_by_name("Wall") == 1
    content = json.loads((tmp_path / "panoptic.json").read_text())
    content["categories"][0]["name"] = "Tapete"
    (tmp_path / "panoptic.json").write_text(json.dumps(content))
    refuses("unplaced Tapete classes.toml", tmp_path)


def test_a_list_of_classes_is_read_back_as_written(tmp_path: Path) -> None:
    labels = known_table("nyu40").labels
    said = ClassRow(id=5, thing=False), ClassRow(name="sofa", into="chair"), ClassRow(id=39, into="void")
    choice = ClassChoice(rows=said)
    rows = named_classes(labels, choice)
    assert [(row.label, row.name, row.into, row.is_thing) for row in rows if row.label in (5, 6, 39)] == [
        (5, "chair", "chair", False), (6, "sofa", "chair", False), (39, "otherfurniture", "void", True)
    ]  # fmt: skip
    path = tmp_path / "classes.toml"
    path.write_text(class_choice_text(choice_of(rows)))
    again = read_class_choice(path)
    assert named_classes((), again) == rows, "the file needs no other table"
    assert named_classes(labels, again) == rows


def test_a_written_classes_toml_keeps_all_choices(tmp_path: Path) -> None:
    rows = (ClassRow(id=3, name='a "b" \\ ü', thing=True), ClassRow(name="wall", into="floor"))
    choice = ClassChoice(tmp_path / "c.toml", "coco", True, frozenset({255, 7}), rows)
    (tmp_path / "c.toml").write_text(class_choice_text(choice), encoding="utf-8")
    assert read_class_choice(tmp_path / "c.toml") == choice


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("table = 'coco", "not-toml"),
        ("table = 'imagenet'", "unknown-table imagenet"),
        ("to = 'coco'", "wrong-type coco"),
        ("void = 255", "wrong-type void 255"),
        ("classes = []", "unknown-field classes"),
        ("[class]\nid = 1", "classes-not-list"),
        ("[[class]]\nid = -1", "wrong-type class id"),
        ("[[class]]\nid = true", "wrong-type"),
        ("[[class]]\nthing = true", "bad-record id"),
        ("[[class]]\nid = 1\nthing = 1", "wrong-type class thing true false"),
        ("[[class]]\nid = 1\nname = ''", "bad-record class line"),
        ("[[class]]\nid = 1\nsize = 3", "unknown-field size class"),
        ("[[class]]\nid = 1\ncolour = 'red'", "bad-record class"),
        ("[[class]]\nid = 77", "class-unnamed 77"),
        ("[[class]]\nname = 'sofa'", "no-such-class sofa"),
    ],
)
def test_bad_classes_toml_files_give_one_line_errors(tmp_path: Path, text: str, told: str) -> None:
    folder = scene_with(tmp_path, text)
    with raises_key(f"{told} classes.toml") as caught:
        open_scene(folder)
    assert "\n" not in str(caught.value)


def test_the_class_list_of_a_scene_is_edited_and_written(tmp_path: Path) -> None:
    folder = scene_with(tmp_path, "void = [9]\n")
    source, edited = SceneSource(folder), tmp_path / "edited.json"
    listed = list_classes(source)
    assert listed.path == folder / "classes.toml" and listed.void == (9,)
    assert [row.name for row in listed.rows] == ["wall", "floor", "cabinet", "chair", "ceiling"]
    rows = tuple(replace(row, into="furniture") if row.name in ("cabinet", "chair") else row for row in listed.rows)
    edited.write_text(to_text(to_json(replace(listed, rows=rows))))
    assert write_class_list(source, edited) == listed.path
    assert [each.name for each in open_scene(folder).classes.categories] == ["wall", "floor", "furniture", "ceiling"]
    again = list_classes(source)
    assert again.rows == rows and again.void == (9,)
    wrongs = ({"path": "elsewhere"}, "other-scene"), ({"rows": []}, "no-classes"), ({"void": 1}, "wrong-type void")
    for wrong, told in wrongs:
        edited.write_text(json.dumps({**json.loads(to_text(to_json(listed))), **wrong}))
        with raises_key(told):
            write_class_list(source, edited)


def test_a_class_table_can_be_named_if_files_name_none(tmp_path: Path) -> None:
    write_pairs(tmp_path, ("semantic", "instance"))
    source, edited = SceneSource(tmp_path), tmp_path / "edited.json"
    with raises_key("no-class-names"):
        list_classes(source)
    with raises_key("no-class-table nyu41"):
        list_classes(source, "nyu41")
    listed = list_classes(source, "nyu40")
    assert listed.path == tmp_path / "masks" / "classes.toml" and len(listed.rows) == 40
    edited.write_text(to_text(to_json(listed)))
    write_class_list(source, edited)
    assert len(open_scene(tmp_path).classes) == 40
