"""The menus, where F3 finds what the panels have: every command is in one of them."""

from __future__ import annotations

from types import ModuleType

import bpy
from plgs.ui.menus import CLASSES

ELSEWHERE = {
    # of the mouse and keys in a 3D view, and of rows in lists
    "pick", "point_at", "rename_selected", "delete_selected", "select_instance", "select_class",
    "matte_class", "go_to_mask", "go_to_frame",
    # File > Import and Export, and files that are dropped
    "browse_scene", "export_lift", "open_dropped",
    # beside what they look at, cancel or mend
    "look_at_scene", "refresh_lifts", "watch_lift", "open_log", "show_finding", "go_to_finding", "leave_out",
    "cancel_frames", "cancel_poses", "cancel_masks", "cancel_diagnosis", "cancel_export",
    "cancel_split",
    # the preferences
    "set_up_engine", "cancel_engine_set_up", "add_to_engine", "cancel_adding", "use_this_python", "check_engine",
    "open_set_up_log", "remove_engine",
}  # fmt: skip


def test_every_command_is_in_a_menu(plgs: ModuleType) -> None:
    plgs.register()
    try:
        registered = set(dir(bpy.ops.plgs))
        entries = [entry for menu in CLASSES for entry in menu.entries]
        for name, given, _ in entries:
            properties = getattr(bpy.ops.plgs, name.removeprefix("plgs.")).get_rna_type().properties
            for each, value in given.items():
                items = getattr(properties[each], "enum_items", None)
                assert items is None or value in items, f"{name} {each} {value}"
    finally:
        plgs.unregister()
    assert {name.removeprefix("plgs.") for name, *_ in entries} == registered - ELSEWHERE
    texts = [text or name for name, _, text in entries]
    assert len(set(texts)) == len(texts), "two entries that read alike"
