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
    """By name, for add-ons of Blender's own do leave something; tests/test_register.py looks at everything."""
    window.open_sidebar()
    window.run(FOOTPRINT)
    window.run("def ours(): return [each for each in _lines(footprint()) if 'plgs' in each.lower()]")
    switched_on = window.ask("ours()")
    assert any("Scene.plgs" in each for each in switched_on) and any("PLGS_PT_" in each for each in switched_on)
    for _ in range(3):
        window.run("bpy.ops.script.reload()")
        window.settle()
        assert window.ask("ours()") == switched_on
        window.run("bpy.ops.preferences.addon_disable(module=EXTENSION)")
        window.settle()
        assert window.ask("ours()") == []
        assert window.ask("running_timers(EXTENSION)") == []
        window.run("bpy.ops.preferences.addon_enable(module=EXTENSION)")
        window.settle()
        assert window.ask("ours()") == switched_on
