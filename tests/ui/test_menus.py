"""Searching and sorting the lists; the menus, where F3 finds what the panels have."""

from types import ModuleType, SimpleNamespace

import bpy
import pytest
from plgs.ui.menus import CLASSES
from plgs.ui.result_panel import places_of, shown_rows

ROWS = [
    SimpleNamespace(name="chair 10", points=5, score=0.2),
    SimpleNamespace(name="chair 2", points=50, score=0.9),
    SimpleNamespace(name="Bin 1", points=20, score=0.5),
    SimpleNamespace(name="wall", points=900, score=0.0),
]


def test_the_object_search_needs_all_words_and_ignores_case() -> None:
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
def test_the_object_list_can_be_sorted(order: str, names: list[str]) -> None:
    places = places_of(ROWS, order)
    assert [row.name for _, row in sorted(zip(places, ROWS, strict=True), key=lambda pair: pair[0])] == names


ELSEWHERE = {
    "quit",  # a key, while a lift runs
    # of the mouse and keys in a 3D view, and of rows in lists
    "pick", "point_at", "rename_selected", "isolate_selected", "delete_selected", "select_instance", "select_class",
    "choose_lift",
    "matte_class", "go_to_mask", "go_to_frame",
    # File > Import and Export, and files that are dropped
    "browse_scene", "export_lift", "export_shown", "open_dropped",
    # beside what they look at, cancel or mend
    "look_at_scene", "refresh_lifts", "watch_lift", "open_log", "show_finding", "go_to_finding", "leave_out",
    "cancel_frames", "cancel_film", "cancel_depth", "cancel_poses", "cancel_masks", "cancel_diagnosis", "cancel_export",
    "cancel_split", "cancel_removal", "bake_changed_shot",
    # the preferences
    "set_up_engine", "cancel_engine_set_up", "add_to_engine", "cancel_adding", "use_this_python", "check_engine",
    "open_set_up_log", "remove_engine",
}  # fmt: skip


def test_every_command_is_in_a_menu(plgs: ModuleType) -> None:
    plgs.register()
    try:
        registered = set(dir(bpy.ops.plgs))
        listed = [entry for menu in CLASSES for entry in menu.entries]
        entries = [(entry, {}, "") if isinstance(entry, str) else entry for entry in listed]
        for name, given, _ in entries:
            properties = getattr(bpy.ops.plgs, name).get_rna_type().properties
            for each, value in given.items():
                items = getattr(properties[each], "enum_items", None)
                assert items is None or value in items, f"{name} {each} {value}"
    finally:
        plgs.unregister()
    assert {name for name, *_ in entries} == registered - ELSEWHERE
    texts = [text or name for name, _, text in entries]
    assert len(set(texts)) == len(texts), "two entries that read alike"
