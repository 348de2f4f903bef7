"""What panels draw, as lines of text: Blender draws them only in a window, so here a layout notes what it is told."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import bpy
import tiny_lift
from plgs.engine.errors import PlgsError
from plgs.engine.job.task import LIFT, TaskProgress, TaskState
from plgs.plgs_blender.engine_environment.tasks import SetUp
from plgs.plgs_blender.registry import Task
from plgs.plgs_blender.running import lifts
from plgs.plgs_blender.running.exports import Export
from plgs.plgs_blender.running.importing import FrameMaking, FrameOrder
from plgs.plgs_blender.running.preparation import MaskMaking
from plgs.plgs_blender.settings import chosen_scene
from plgs.ui import corrections_panel, lift_panel, passes_panel, preferences, result_panel, scene_panel, sidebar

PANELS = (sidebar, scene_panel, lift_panel, result_panel, corrections_panel, passes_panel)


class Layout:
    """In the place of Blender's: it notes texts and operators, and refuses names that Blender does not know."""

    def __init__(self, seen: list[str], *, opened: bool = True) -> None:
        """``opened``: whether what can be folded up inside a panel is open."""
        self.__dict__["seen"], self.__dict__["opened"] = seen, opened

    def __setattr__(self, name: str, value: object) -> None:
        assert name in bpy.types.UILayout.bl_rna.properties, name

    def __getattr__(self, name: str) -> Any:
        assert name in bpy.types.UILayout.bl_rna.functions or name == "context_pointer_set", name

        def call(*given: object, **options: object) -> Any:
            if name in ("operator", "operator_menu_enum"):
                self.seen.append(f"{given[0]} {options.get('text', '')}".strip())
                group, _, called = str(given[0]).partition(".")
                getattr(getattr(bpy.ops, group), called).get_rna_type()
                return SimpleNamespace()
            if name == "prop":
                getattr(given[0], str(given[1]))
                self.seen.append(f"field {given[1]}")
            self.seen.append(str(options.get("text", "")))
            return (self, self if self.opened else None) if name == "panel" else self

        return call


class Height:
    """In the place of Blender's layout: how high it is, in rows, with what can be folded up closed."""

    def __init__(self, parts: list[Height] | None = None, *, is_row: bool = False) -> None:
        self.parts, self.is_row, self.scale_y = [] if parts is None else parts, is_row, 1.0

    @property
    def rows(self) -> float:
        heights = [part.rows for part in self.parts] or [1.0]
        return self.scale_y * (max(heights) if self.is_row else sum(heights))

    def __getattr__(self, name: str) -> Any:
        def call(*given: object, **options: object) -> Any:
            self.parts.append(part := Height(is_row=name in ("row", "split")))
            return (part, None) if name == "panel" else part

        return call


def height_of(panel: type[bpy.types.Panel]) -> float:
    """How high a panel is in a sidebar as wide as Blender opens it, in rows."""
    layout = Height()
    panel.draw(SimpleNamespace(layout=layout), _context(280))  # type: ignore[arg-type]
    return layout.rows


def _context(width: int) -> Any:
    return SimpleNamespace(
        scene=bpy.context.scene,
        view_layer=bpy.context.view_layer,
        region=SimpleNamespace(width=width),
        preferences=SimpleNamespace(system=SimpleNamespace(ui_scale=1.0)),
        active_object=None,
        space_data=None,
    )


def drawn(*, opened: bool = True, width: int = 10_000, steps: bool = True) -> str:
    """What all panels and the preferences show in a sidebar of this width. ``steps``: whether those before the result
    are open."""
    context = _context(width)
    bpy.context.scene.plgs.show_steps = steps
    seen: list[str] = []
    for module in PANELS:
        for panel in module.CLASSES:
            if issubclass(panel, bpy.types.Panel) and getattr(panel, "poll", lambda _: True)(context):
                panel.draw(SimpleNamespace(layout=Layout(seen, opened=opened)), context)
    chosen = SimpleNamespace(
        layout=Layout(seen), engine_python="", base_python="", torch_build="cpu", index_url="", defaults_file="",
    )  # fmt: skip
    preferences.PLGS_AP_preferences.draw(chosen, context)
    return "\n".join(seen)


class Pretended:
    """A follower in any state."""

    kind = LIFT

    def __init__(self, state: TaskState, error: PlgsError | None = None) -> None:
        self.state, self.error, self.answer, self.log_lines = state, error, None, ("a line of the log",)
        self.progress = TaskProgress("s", "Half of it", 2, 3, 5, 10, 0.5, 90.0, warnings=["odd"])
        self.is_running = state is TaskState.RUNNING

    def kill(self) -> None: ...
    def close(self) -> None: ...
    def poll(self) -> bool:
        return False


def followed_lift(folder: Path, state: TaskState = TaskState.RUNNING) -> tuple[lifts.Lift, Any]:
    """A finished lift in a new folder, to which the panel is set, and its follower, which is in this state."""
    bpy.context.scene.plgs.lift_folder = str(tiny_lift.write_tiny_lift(folder).path)
    followed = lifts.lift_of(folder)
    followed.follower = follower = Pretended(state)  # type: ignore[assignment]
    return followed, follower


def tasks_with(follower: Any, folder: Path) -> list[Task]:
    chosen = chosen_scene(bpy.context.scene.plgs)
    order = FrameOrder(chosen, "", ("cloud",))
    return [
        MaskMaking(chosen, follower),
        FrameMaking(order, folder, follower),
        Export(folder, "coco", folder, "", follower),
        SetUp(follower),
    ]
