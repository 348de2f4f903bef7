"""Following a diagnosis: by a timer of Blender's in a window, to its end in a script."""

from __future__ import annotations

import time
from pathlib import Path

import bpy

from .. import scene_diagnosis
from ..engine_environment import usable_python
from ..redrawing import redraw_panels
from ..scene_diagnosis import SceneDiagnosis
from ..scene_formats import AUTOMATIC
from ..settings import PLGS_PG_settings, place_of
from . import poll_timer

_TICK_S = 0.2


def diagnose(settings: PLGS_PG_settings, mended: Path | None = None, *, waits: bool = True) -> SceneDiagnosis:
    """Let an engine measure the panel's scene, and with ``mended`` write it there, mended.

    Where it ``waits`` it returns the answer, and else at once: the panel shows what comes. Without a window it always
    waits. Raises JobError when there is no engine.
    """
    diagnosis = scene_diagnosis.begin(place_of(settings), usable_python(), mended)
    if not waits and not bpy.app.background:
        if not bpy.app.timers.is_registered(_tick):
            bpy.app.timers.register(_tick, first_interval=_TICK_S, persistent=True)
        return diagnosis
    try:
        while (answer := scene_diagnosis.poll()) is None:
            time.sleep(0.02)
    except KeyboardInterrupt:
        scene_diagnosis.forget()
        raise
    _take(answer)
    return answer


def free_mended_folder(scene_folder: Path) -> Path:
    """A folder beside the scene's that is not there yet: "room_mended", or "room_mended_2" and so on."""
    number, folder = 1, scene_folder.with_name(f"{scene_folder.name}_mended")
    while folder.exists():
        number += 1
        folder = scene_folder.with_name(f"{scene_folder.name}_mended_{number}")
    return folder


def _tick() -> float | None:
    answer = scene_diagnosis.poll()
    if answer is not None:
        _take(answer)
        redraw_panels()
    return _TICK_S if scene_diagnosis.is_running() else None


def _take(answer: SceneDiagnosis) -> None:
    """Point the panels that show the scene at the mended one, which has its masks and its axis up in it."""
    if answer.mended is None:
        return
    for scene in bpy.data.scenes:
        if scene.plgs.scene_folder and place_of(scene.plgs) == answer.place:
            _point_at(scene.plgs, answer.mended)
    if not bpy.app.background:
        poll_timer.remember_step("PLGS Fix")


def _point_at(settings: PLGS_PG_settings, mended: Path) -> None:
    """Each assignment lets the folder be looked at: so only what differs is assigned, and the folder last."""
    values = {"masks": "", "depth": "", "up": "z", "format": AUTOMATIC, "scene_folder": str(mended)}
    for name, value in values.items():
        if getattr(settings, name) != value:
            setattr(settings, name, value)


def unregister() -> None:
    """End a measurement that goes on."""
    if bpy.app.timers.is_registered(_tick):
        bpy.app.timers.unregister(_tick)
    scene_diagnosis.forget()
