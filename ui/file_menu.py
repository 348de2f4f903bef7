"""File > Import > PLGS Scene."""

from __future__ import annotations

import bpy


def _draw(menu: bpy.types.Menu, context: bpy.types.Context) -> None:
    menu.layout.operator("plgs.browse_scene", text="PLGS Scene (ScanNet, COLMAP, transforms.json, .sens, .r3d ...)")


def register() -> None:
    bpy.types.TOPBAR_MT_file_import.append(_draw)


def unregister() -> None:
    bpy.types.TOPBAR_MT_file_import.remove(_draw)
