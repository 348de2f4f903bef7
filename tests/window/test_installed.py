"""The extension in a window: it is there, its tab opens, and it goes without a trace."""

from __future__ import annotations

from pathlib import Path

from blender import Window

FOOTPRINT = (Path(__file__).parent.parent / "footprint.py").read_text()


def test_the_zip_is_installed_and_switched_on(window: Window) -> None:
    where = window.ask("__import__('sys').modules[EXTENSION].__file__")
    assert where == str(window.folder / "resources/extensions/user_default/plgs/__init__.py")
    assert window.ask("EXTENSION in bpy.context.preferences.addons and hasattr(bpy.context.scene, 'plgs')")


def test_the_sidebar_has_the_tab_and_its_buttons(window: Window) -> None:
    window.open_sidebar()
    window.screenshot("sidebar")
    window.find_button("plgs.import_scene")


def test_switching_off_and_on_and_reloading_leaves_nothing_behind(window: Window) -> None:
    window.open_sidebar()
    window.run(FOOTPRINT)
    window.run("switched_on = footprint()")
    window.run("bpy.ops.preferences.addon_disable(module=EXTENSION)")
    window.run("switched_off = footprint()")
    assert window.ask("[each for kind in switched_off.values() for each in kind if 'plgs' in each.lower()]") == []
    for _ in range(3):
        window.run("bpy.ops.preferences.addon_enable(module=EXTENSION)")
        window.settle()
        assert window.ask("footprint() == switched_on")
        window.run("bpy.ops.script.reload()")
        window.settle()
        assert window.ask("footprint() == switched_on")
        window.run("bpy.ops.preferences.addon_disable(module=EXTENSION)")
        window.settle()
        assert window.ask("footprint() == switched_off")
        assert window.ask("running_timers(EXTENSION)") == []
    window.run("bpy.ops.preferences.addon_enable(module=EXTENSION)")
