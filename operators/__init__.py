"""The user's actions. Each operator checks the context, calls one function of `plgs_blender`, and reports the outcome.

From a script they take the same arguments as from their buttons.
"""

from __future__ import annotations

from ..plgs_blender.lifecycle import register_modules, unregister_modules
from . import corrections, engine, inspect, lift, masks, passes, pointing, scene

_MODULES = (engine, lift, passes, scene, masks, inspect, corrections, pointing)
for _module in _MODULES:
    vars(_module)["CLASSES"] = [each for name, each in vars(_module).items() if name.startswith("PLGS_")]


def register() -> None:
    """Called when the extension is enabled."""
    register_modules(_MODULES)


def unregister() -> None:
    """Called when the extension is disabled."""
    unregister_modules(_MODULES)
