"""The extension itself: on, off, and without Blender."""

import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import bpy
import pytest
from footprint import difference, footprint, running_timers


@pytest.fixture
def draw_handlers(monkeypatch: pytest.MonkeyPatch) -> list[object]:
    """Draw handlers that were added and not removed. Blender has no list of them: so the calls are noted."""
    added: list[object] = []
    for name in ("SpaceView3D", "SpaceImageEditor", "SpaceNodeEditor", "SpaceProperties", "SpaceOutliner"):
        space = getattr(bpy.types, name)
        monkeypatch.setattr(space, "draw_handler_add", noting(space.draw_handler_add, added.append))
        monkeypatch.setattr(space, "draw_handler_remove", noting(space.draw_handler_remove, None, added.remove))
    return added


def noting(
    call: Callable[..., object],
    result: Callable[[object], None] | None,
    handle: Callable[[object], None] | None = None,
) -> Callable[..., object]:
    """`call`, which also hands its result, or its first argument, on."""

    def noted(*arguments: object) -> object:
        answer = call(*arguments)
        if result is not None:
            result(answer)
        if handle is not None:
            handle(arguments[0])
        return answer

    return noted


def test_switching_on_and_off_leaves_nothing_behind(plgs: ModuleType, draw_handlers: list[object]) -> None:
    before = footprint()
    for _ in range(3):
        plgs.register()
        assert "Scene.plgs" in footprint()["properties"]
        plgs.unregister()
        assert difference(before, footprint()) == []
        assert running_timers("plgs") == []
        assert draw_handlers == []


def test_the_root_imports_without_blender(root: Path) -> None:
    code = (
        "import importlib.util, sys; sys.modules['bpy'] = None; "
        f"spec = importlib.util.spec_from_file_location('plgs', {str(root / '__init__.py')!r}); "
        "module = importlib.util.module_from_spec(spec); spec.loader.exec_module(module); print(module.__doc__)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True, timeout=120)


def test_the_page_on_scripting_names_every_operator(plgs: ModuleType, root: Path) -> None:
    text = (root / "docs" / "scripting.md").read_text(encoding="utf-8")
    rows = text.split("| operator `plgs.` |", 1)[1].split("\n\n", 1)[0].splitlines()[2:]
    named = [name for row in rows for name in re.findall(r"`(\w+)`", row.split("|")[1])]
    plgs.register()
    try:
        registered = dir(bpy.ops.plgs)
    finally:
        plgs.unregister()
    assert sorted(named) == sorted(registered)
