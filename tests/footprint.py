"""What an extension could leave behind in Blender. Runs in the tests' own Blender and, as text, in a window's."""

import sys
from collections import Counter
from collections.abc import Iterator
from types import FunctionType

import bpy

KINDS = (
    "AddonPreferences", "AssetShelf", "FileHandler", "Gizmo", "GizmoGroup", "Header", "KeyingSetInfo", "Macro", "Menu",
    "Node", "NodeSocket", "NodeTree", "Operator", "Panel", "PropertyGroup", "RenderEngine", "UIList", "WorkSpaceTool",
)  # fmt: skip
BLENDERS_OWN = ("bpy.types", "bpy_types", "_bpy_types")


def footprint() -> dict[str, list[str]]:
    """Registered classes, properties on Blender's types, handlers, keymap items, entries added to menus and panels."""
    return {
        "classes": sorted(f"{each.__module__}.{each.__qualname__}" for each in _registered_classes()),
        "properties": sorted(_properties()),
        "handlers": sorted(_handlers()),
        "keymap items": sorted(_keymap_items()),
        "menu entries": sorted(_menu_entries()),
    }


def difference(before: dict[str, list[str]], after: dict[str, list[str]]) -> list[str]:
    """What came ("+ handlers: ...") and what went ("- ..."), also of things that are there more than once."""
    lost, won = Counter(_lines(before)), Counter(_lines(after))
    return [f"+ {line}" for line in (won - lost).elements()] + [f"- {line}" for line in (lost - won).elements()]


def _lines(found: dict[str, list[str]]) -> list[str]:
    return [f"{kind}: {each}" for kind, group in found.items() for each in group]


def running_timers(package: str) -> list[str]:
    """Functions of the package's modules that run as application timers. Blender lists none: so each is asked for."""
    modules = [each for name, each in sys.modules.items() if name == package or name.startswith(f"{package}.")]
    functions = {each for module in modules for each in vars(module).values() if isinstance(each, FunctionType)}
    return sorted(each.__qualname__ for each in functions if bpy.app.timers.is_registered(each))


def _registered_classes() -> Iterator[type]:
    """Those of add-ons: Blender makes Python classes of its own types only when they are first looked at."""
    for kind in KINDS:
        waiting = [getattr(bpy.types, kind)] if hasattr(bpy.types, kind) else []
        while waiting:
            below = waiting.pop().__subclasses__()
            waiting += below
            yield from (each for each in below if each.__module__ not in BLENDERS_OWN and each.is_registered)


def _properties() -> Iterator[str]:
    for name in dir(bpy.types):
        rna = getattr(getattr(bpy.types, name), "bl_rna", None)
        if rna is not None:
            yield from (f"{name}.{key}" for key in rna.properties.keys())


def _handlers() -> Iterator[str]:
    for name in dir(bpy.app.handlers):
        functions = getattr(bpy.app.handlers, name)
        if isinstance(functions, list):
            yield from (f"{name}: {each.__module__}.{each.__qualname__}" for each in functions)


def _keymap_items() -> Iterator[str]:
    keyconfig = bpy.context.window_manager.keyconfigs.addon
    for keymap in keyconfig.keymaps if keyconfig else ():
        yield from (f"{keymap.name}: {item.idname} {item.to_string()}" for item in keymap.keymap_items)


def _menu_entries() -> Iterator[str]:
    """Blender keeps a menu's own drawing in the same list, once anybody has added to it."""
    for name in dir(bpy.types):
        draw = getattr(getattr(bpy.types, name), "draw", None)
        for each in getattr(draw, "_draw_funcs", ()):
            if (each.__module__, each.__qualname__) != (getattr(bpy.types, name).__module__, f"{name}.draw"):
                yield f"{name}: {each.__module__}.{each.__qualname__}"
