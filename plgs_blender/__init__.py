"""From a lift's result to Blender's data-blocks, and back to pictures.

Functions here work the same from a script, a test, or an operator: they take a folder and a scene and never
look at selections, modes or windows. Start with `lift_scene.place_lift` and `lift_scene.save_lift`.
"""

from __future__ import annotations

from types import ModuleType


def _modules() -> tuple[ModuleType, ...]:
    """The modules that Blender has to know about, in order, imported late: who only reads a result needs none."""
    from . import compositing, corrections, registry, settings, timeline
    from .engine_environment import tasks
    from .inspecting import lists, selection
    from .running import estimate, importing, looking, preparation

    first = settings, estimate, preparation, lists, selection, registry
    return *first, tasks, looking, importing, corrections, timeline, compositing


def register() -> None:
    """Called when the extension is switched on, before operators and panels."""
    from .lifecycle import register_modules

    register_modules(_modules())


def unregister() -> None:
    """Called when the extension is switched off, after operators and panels."""
    from .lifecycle import unregister_modules

    unregister_modules(_modules())
