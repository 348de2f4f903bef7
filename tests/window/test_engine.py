"""The engine in a window: it is asked by itself, the preferences tell, and a set-up never keeps the window waiting."""

from __future__ import annotations

import socket
import sys
from collections.abc import Iterator

import pytest
from blender import Window

MODULES = """
import sys
engine = sys.modules[EXTENSION + '.plgs_blender.engine_environment.tasks']
registry = sys.modules[EXTENSION + '.plgs_blender.registry']
timer = sys.modules[EXTENSION + '.plgs_blender.registry']
set_up = lambda: registry.latest(engine.SetUp)
"""
PREFERENCES = """
area = next(each for each in bpy.context.window_manager.windows[0].screen.areas if each.type == 'VIEW_3D')
area.ui_type = 'PREFERENCES'
bpy.context.preferences.active_section = 'ADDONS'
bpy.context.window_manager.addon_search = 'PLGS'
bpy.ops.preferences.addon_expand(module=EXTENSION)
answer = None
"""


@pytest.fixture
def preferences(window: Window) -> Iterator[Window]:
    """With the add-on's preferences in the place of the 3D view, and the extension's state at hand."""
    window.run(MODULES)
    window.run(PREFERENCES)
    window.settle()
    yield window
    window.run("bpy.context.preferences.system.use_online_access = False")
    window.run("bpy.ops.preferences.addon_expand(module=EXTENSION)")


def test_the_window_checks_the_engine_automatically(preferences: Window) -> None:
    preferences.wait_for("engine.status().state.value == 'ready'")
    preferences.settle()
    preferences.screenshot("preferences")
    preferences.wait_for("not bpy.app.timers.is_registered(timer.tick)")  # at its next tick, on a busy machine later


def test_the_window_shows_a_set_up_and_can_cancel_it(preferences: Window) -> None:
    assert preferences.ask("bpy.ops.plgs.set_up_engine.poll()") is False
    preferences.run("bpy.context.preferences.system.use_online_access = True")
    base = f"{sys.base_prefix}/bin/python{sys.version_info[0]}.{sys.version_info[1]}"
    with socket.create_server(("127.0.0.1", 0)) as silent:  # uv would wait for minutes
        url = f"http://127.0.0.1:{silent.getsockname()[1]}/simple"
        arguments = f"'INVOKE_DEFAULT', base_python={base!r}, index_url={url!r}"
        assert preferences.run(f"answer = list(bpy.ops.plgs.set_up_engine({arguments}))\n") == ["FINISHED"]
        preferences.wait_for("not set_up().is_running or set_up().progress.stage_index == 1")
        assert preferences.ask("str(set_up().error)") == "None", "it needs 5 GB on the disk of the home"
        preferences.settle()
        preferences.screenshot("preferences-set-up")
        preferences.run("bpy.ops.plgs.cancel_engine_set_up()")
        preferences.wait_for("not set_up().is_running")
    assert preferences.ask("set_up().was_cancelled and set_up().error is None")
    assert not preferences.slow_calls(0.05)
