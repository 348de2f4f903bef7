"""Asking Blender to draw anew what tells of our state."""

from __future__ import annotations

import bpy


def redraw_panels(*, views_too: bool = False) -> None:
    """The sidebars of 3D views, and the preferences. Only if asked the views themselves: those take far longer."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "PREFERENCES":
                area.tag_redraw()
            elif area.type == "VIEW_3D":
                for region in area.regions:
                    if region.type == "UI" or (views_too and region.type == "WINDOW"):
                        region.tag_redraw()
