"""PLGS for Blender: posed RGB-D frames and noisy panoptic masks become one consistent 3D panoptic scene.

This folder is a Blender extension and the repository at once. Here things are only registered; what they do
is in `plgs_blender`, the method itself in `engine`. Importing this needs no Blender.
"""

from __future__ import annotations

from types import ModuleType


def _parts() -> tuple[ModuleType, ...]:
    """Modules with `register` and `unregister`, those that others refer to first."""
    from . import operators, plgs_blender, ui

    return plgs_blender, operators, ui


def register() -> None:
    """Called by Blender when the extension is switched on."""
    for part in _parts():
        part.register()


def unregister() -> None:
    """Called by Blender when the extension is switched off."""
    for part in reversed(_parts()):
        part.unregister()
