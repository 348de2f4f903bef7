"""The extension itself: on, off, and without Blender."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path
from types import ModuleType

import bpy


def footprint() -> dict[str, object]:
    """What an extension could leave behind in Blender."""
    handlers = {name: len(getattr(bpy.app.handlers, name)) for name in dir(bpy.app.handlers)
                if isinstance(getattr(bpy.app.handlers, name), list)}  # fmt: skip
    kinds = (bpy.types.Operator, bpy.types.Panel, bpy.types.PropertyGroup, bpy.types.UIList, bpy.types.Menu)
    # Python's own classes stay, as modules do; what counts is which of them Blender knows.
    classes = {kind.__name__: sorted(each.__name__ for each in kind.__subclasses__() if each.is_registered)
               for kind in kinds}  # fmt: skip
    properties = {
        name: len(getattr(bpy.types, name).bl_rna.properties) for name in ("Scene", "Object", "WindowManager")
    }
    return {"handlers": handlers, "classes": classes, "properties": properties}


def test_switching_on_and_off_leaves_nothing_behind(plgs: ModuleType) -> None:
    before = footprint()
    for _ in range(3):
        plgs.register()
        plgs.unregister()
    assert footprint() == before


def test_the_root_imports_without_blender(root: Path) -> None:
    code = (
        "import importlib.util, sys; sys.modules['bpy'] = None; "
        f"spec = importlib.util.spec_from_file_location('plgs', {str(root / '__init__.py')!r}); "
        "module = importlib.util.module_from_spec(spec); spec.loader.exec_module(module); print(module.__doc__)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)


def test_blenders_own_tool_accepts_the_manifest(root: Path) -> None:
    """As a built package, which also shows what is in it."""
    tool = Path(bpy.utils.resource_path("LOCAL")) / "scripts/addons_core/bl_pkg/cli/blender_ext.py"
    run = subprocess.run([sys.executable, tool, "validate", str(root)], capture_output=True, text=True)
    assert run.returncode == 0, run.stdout + run.stderr
    manifest = tomllib.loads((root / "blender_manifest.toml").read_text())
    assert manifest["id"] == "plgs" and "wheels" not in manifest
