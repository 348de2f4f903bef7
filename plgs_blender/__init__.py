"""From a lift's result to Blender's data-blocks, and back to pictures.

Functions here work the same from a script, a test, or an operator: they take a folder and a scene and never
look at selections, modes or windows. Start with `lift_scene.place_lift` and `lift_scene.save_lift`.
"""

from __future__ import annotations

from types import ModuleType


def _modules() -> tuple[ModuleType, ...]:
    """The modules that Blender has to know about, in order. They are imported late: a script that only reads a result
    needs none of them."""
    from . import compositing, corrections, mask_classes, settings, timeline
    from .engine_environment import tasks
    from .inspecting import lists, selection
    from .running import chosen_picture, looking, used_options
    from .tasks import timer

    first = settings, used_options, mask_classes, lists, selection, timer
    return *first, tasks, looking, chosen_picture, corrections, timeline, compositing


def register() -> None:
    """Called when the extension is switched on, before operators and panels."""
    from .registration import register_modules

    register_modules(_modules())


def unregister() -> None:
    """Called when the extension is switched off, after operators and panels."""
    from .registration import unregister_modules

    unregister_modules(_modules())
