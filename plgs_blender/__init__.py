"""Turns a lift's result into Blender data-blocks. Start with `lift_scene.place_lift` and `lift_scene.save_lift`.

They behave the same in a script, a test or an operator: no selection, mode or window matters."""

from __future__ import annotations

from types import ModuleType


def _modules() -> tuple[ModuleType, ...]:
    """Return the modules to register, in order. They are imported late, as readers of results need none of them."""
    from . import compositing, corrections, moving, registry, settings, startup_file, timeline
    from .engine_environment import tasks
    from .inspecting import lists, selection
    from .running import estimate, importing, looking, preparation

    first = settings, estimate, preparation, lists, selection, registry
    return *first, tasks, looking, importing, corrections, moving, startup_file, timeline, compositing


def register() -> None:
    """Register all modules: called first, before operators and panels, when the extension is enabled."""
    from .lifecycle import register_modules

    register_modules(_modules())


def unregister() -> None:
    """Unregister all modules: called last, after operators and panels, when the extension is disabled."""
    from .lifecycle import unregister_modules

    unregister_modules(_modules())
