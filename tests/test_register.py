"""The extension itself: on, off, and without Blender."""

import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import bpy
import pytest
from footprint import difference, footprint, running_timers


@pytest.fixture
def draw_handlers(monkeypatch: pytest.MonkeyPatch) -> list[object]:
    """Draw handlers that were added and not removed. Blender has no list of them: so the calls are noted."""
    added: list[object] = []
    for name in ("SpaceView3D", "SpaceImageEditor", "SpaceNodeEditor", "SpaceProperties", "SpaceOutliner"):
        space = getattr(bpy.types, name)
        add, remove = space.draw_handler_add, space.draw_handler_remove

        def noted_add(*arguments: Any, add: Any = add) -> object:
            added.append(add(*arguments))
            return added[-1]

        def noted_remove(*arguments: Any, remove: Any = remove) -> None:
            remove(*arguments)
            added.remove(arguments[0])

        monkeypatch.setattr(space, "draw_handler_add", noted_add)
        monkeypatch.setattr(space, "draw_handler_remove", noted_remove)
    return added


def test_enabling_and_disabling_the_extension_leaves_no_trace(plgs: ModuleType, draw_handlers: list[object]) -> None:
    before = footprint()
    for _ in range(3):
        plgs.register()
        assert "Scene.plgs" in footprint()["properties"]
        plgs.unregister()
        assert difference(before, footprint()) == []
        assert running_timers("plgs") == []
        assert draw_handlers == []


def test_the_extensions_root_module_imports_without_blender(root: Path) -> None:
    code = (
        "import importlib.util, sys; sys.modules['bpy'] = None; "
        f"spec = importlib.util.spec_from_file_location('plgs', {str(root / '__init__.py')!r}); "
        "module = importlib.util.module_from_spec(spec); spec.loader.exec_module(module); print(module.__doc__)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True, timeout=120)


def test_scripting_md_names_every_operator(plgs: ModuleType, root: Path) -> None:
    text = (root / "docs" / "scripting.md").read_text(encoding="utf-8")
    rows = text.split("| operator `plgs.` |", 1)[1].split("\n\n", 1)[0].splitlines()[2:]
    named = [name for row in rows for name in re.findall(r"`(\w+)`", row.split("|")[1])]
    plgs.register()
    try:
        registered = dir(bpy.ops.plgs)
    finally:
        plgs.unregister()
    assert sorted(named) == sorted(registered)


def test_the_extension_is_loaded_only_once(root: Path) -> None:
    """pytest would import the root `__init__.py` again, under the folder's name, were it not kept from it."""
    ours = str(root / "__init__.py")
    assert [name for name, module in sys.modules.items() if getattr(module, "__file__", "") == ours] == ["plgs"]
