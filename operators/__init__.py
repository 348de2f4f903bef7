"""What the user can do. Each operator checks the context, calls one function of `plgs_blender`, and reports.

All of them work from a script with the same arguments as from their buttons.
"""

from __future__ import annotations

from ..plgs_blender.lifecycle import register_modules, unregister_modules
from . import corrections, engine, inspect, lift, masks, passes, pointing, scene

_MODULES = (engine, lift, passes, scene, masks, inspect, corrections, pointing)


def register() -> None:
    """Called when the extension is switched on."""
    register_modules(_MODULES)


def unregister() -> None:
    """Called when the extension is switched off."""
    unregister_modules(_MODULES)
