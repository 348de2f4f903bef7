"""Panels, lists, preferences and view overlays. They only read state: no computing, and no disk access."""

from __future__ import annotations

from functools import partial

from ..plgs_blender.lifecycle import list_classes, register_modules, unregister_modules
from . import (
    corrections_panel,
    lift_panel,
    menus,
    overlay,
    passes_panel,
    preferences,
    result_panel,
    scene_panel,
    sidebar,
)

_MODULES = (
    preferences, sidebar, lift_panel, passes_panel, scene_panel, result_panel, corrections_panel, menus, overlay,
)  # fmt: skip
list_classes(_MODULES)
register, unregister = partial(register_modules, _MODULES), partial(unregister_modules, _MODULES)
"""Called when the extension is enabled, and disabled."""
