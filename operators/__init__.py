"""The user's actions. Each operator checks the context, calls one function of `plgs_blender`, and reports the outcome.
Called from a script, an operator takes the same arguments as from its button."""

from __future__ import annotations

from functools import partial

from ..plgs_blender.lifecycle import list_classes, register_modules, unregister_modules
from . import corrections, engine, inspect, lift, masks, passes, pointing, scene

_MODULES = (engine, lift, passes, scene, masks, inspect, corrections, pointing)
list_classes(_MODULES)
register, unregister = partial(register_modules, _MODULES), partial(unregister_modules, _MODULES)
"""Called when the extension is enabled, and disabled."""
