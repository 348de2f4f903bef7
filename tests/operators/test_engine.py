"""The engine's operators, as scripts call them."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import bpy
import pytest
from plgs.plgs_blender import engine_environment
from plgs.plgs_blender.engine_environment import EngineState, choices, tasks
from pretended_python import pretended_python

from tests.raises_key import worded

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="the cache folder is chosen by XDG_CACHE_HOME")


@pytest.fixture(autouse=True)
def nothing_chosen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("PLGS_ENGINE_PYTHON", raising=False)
    yield
    choices.choose(None)


def test_use_this_python_accepts_a_python_or_says_what_it_lacks(tmp_path: Path) -> None:
    good = pretended_python(tmp_path / "good")
    assert bpy.ops.plgs.use_this_python(python=str(good)) == {"FINISHED"}
    assert engine_environment.status().state is EngineState.READY and engine_environment.usable_python() == good
    assert bpy.ops.plgs.check_engine() == {"FINISHED"}
    with pytest.raises(RuntimeError, match="lacks torch"):
        bpy.ops.plgs.use_this_python(python=str(pretended_python(tmp_path / "bare", torch=None)))
    with pytest.raises(RuntimeError, match="/nowhere/python"):
        bpy.ops.plgs.use_this_python(python="/nowhere/python")


def test_engine_buttons_that_cannot_act_say_why() -> None:
    assert not bpy.ops.plgs.set_up_engine.poll()
    with pytest.raises(RuntimeError, match="Allow online access in Preferences > System"):
        bpy.ops.plgs.set_up_engine()
    with pytest.raises(RuntimeError, match="nothing to cancel"):
        bpy.ops.plgs.cancel_engine_set_up()
    with pytest.raises(RuntimeError, match="There is no log"):
        bpy.ops.plgs.open_set_up_log()
    with pytest.raises(RuntimeError, match="without being installed"):
        bpy.ops.plgs.show_preferences()


def test_a_failed_set_up_gives_its_reason(tmp_path: Path) -> None:
    bpy.context.preferences.system.use_online_access = True
    with pytest.raises(RuntimeError, match=worded("no-python")):
        bpy.ops.plgs.set_up_engine(base_python=str(tmp_path / "none"))
    assert bpy.ops.plgs.open_set_up_log() == {"FINISHED"}
    bpy.context.preferences.system.use_online_access = False


def test_remove_engine_deletes_only_engines_that_plgs_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tasks, "check", lambda: None)
    folder = tmp_path / "cache" / "plgs"
    (folder / "engine-3.11-abc").mkdir(parents=True)
    (folder / "engine-3.11-abc" / "pyvenv.cfg").touch()
    (folder / "plgs-kernels-abc").mkdir()
    assert bpy.ops.plgs.remove_engine() == {"FINISHED"}
    assert [path.name for path in folder.iterdir()] == ["plgs-kernels-abc"]


INSTALLED = """
import sys, bpy
from pathlib import Path
repository = bpy.context.preferences.extensions.repos.new(
    name="Dev", module="plgsdev", custom_directory=sys.argv[1], source="USER")
bpy.ops.preferences.addon_enable(module="bl_ext.plgsdev.plgs")
preferences = bpy.context.preferences.addons["bl_ext.plgsdev.plgs"].preferences
from bl_ext.plgsdev.plgs.plgs_blender.engine_environment import choices, tasks
from bl_ext.plgsdev.plgs.plgs_blender import registry
assert choices.preferences() is not None and choices.chosen_python() is None
preferences.engine_python = sys.argv[2]  # asks at once
assert tasks.status().state.value == "checking", tasks.status()
registry.wait_for(registry.latest(tasks.EngineCheck), bpy.context.scene)
assert tasks.status().state.value == "ready", tasks.status()
preferences.torch_build, preferences.base_python, preferences.index_url = "cuda", "/base", " http://index "
chosen = choices.set_up_choice()
assert chosen == choices.SetUpChoice(Path("/base"), "cuda", "http://index"), chosen
assert choices.set_up_choice("/other", "cpu") == choices.SetUpChoice(Path("/other"), "cpu", "http://index")
bpy.ops.plgs.use_this_python(python=sys.argv[2])
preferences.engine_python = ""
assert choices.chosen_python() is None
bpy.ops.preferences.addon_disable(module="bl_ext.plgsdev.plgs")
print("all good")
"""


def test_an_installed_extension_keeps_its_preferences(root: Path, tmp_path: Path) -> None:
    repository = tmp_path / "repository"
    repository.mkdir()
    (repository / "plgs").symlink_to(root)
    good = pretended_python(tmp_path / "good")
    command = [sys.executable, "-c", INSTALLED, str(repository), str(good)]
    said = subprocess.run(command, capture_output=True, text=True, timeout=60, cwd=tmp_path)
    assert "all good" in said.stdout, said.stderr
