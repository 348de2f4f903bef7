"""Runs in the Blender under test (`blender --python`): answers questions that tests put into a folder.

A question is a file `<number>.py`, its answer a file `<number>.json`; both appear by rename. A question is an
expression, whose value is the answer, or statements, which leave their answer in `answer`. They run one at a time in an
application timer, in a namespace that lasts. No threads, no sockets: as the extension itself.
"""

from __future__ import annotations

import contextlib
import gc
import json
import os
import sys
import time
import traceback
from pathlib import Path
from types import CodeType

import bpy

FOLDER = Path(os.environ["PLGS_WINDOW_QUESTIONS"])
EXTENSION = "bl_ext.user_default.plgs"
PAUSE = 0.01
SCHEDULING = Path("/proc/thread-self/schedstat")
"""Of Linux: nanoseconds on a processor, and nanoseconds waiting for one."""
FULL = 2
"""The oldest generation of the garbage collector, which is all objects."""


def _clock() -> float:
    """Seconds, without those in which this thread was ready to run and had no processor."""
    return time.perf_counter() - int(SCHEDULING.read_text().split()[1]) * 1e-9


class Watch:
    """How long Blender's window waits for the extension: each time that Blender calls it, from entry to return.

    The interpreter tells of entries and returns (`sys.monitoring`), so nothing of the extension is wrapped or changed.
    What the kernel let Blender wait for a processor, when others had all of them, is left out: it is not our doing. So
    is a full collection of garbage: it goes over all that Blender's interpreter holds (0.05 s for 74 000 objects), at
    a moment that chance chooses, so that the shortest call of ours can meet it. ``waits`` has the longest time of each
    call, ``again`` the second longest.
    """

    TOOL = sys.monitoring.PROFILER_ID

    def __init__(self) -> None:
        self.paused = False
        self.waits: dict[str, float] = {}
        self.again: dict[str, float] = {}
        self._depth = 0
        self._since = 0.0
        self._entry = ""
        self._ours = ""
        self._collecting = 0.0
        gc.callbacks.append(self._on_collection)

    def begin(self) -> None:
        """Forget what was measured, and measure from now on."""
        module = sys.modules[EXTENSION]
        self._ours = os.path.dirname(module.__file__ or "") + os.sep
        self.waits, self.again, self._depth = {}, {}, 0
        events, monitoring = sys.monitoring.events, sys.monitoring
        if monitoring.get_tool(self.TOOL) is None:
            monitoring.use_tool_id(self.TOOL, "plgs window tests")
            for event in (events.PY_START, events.PY_RESUME, events.PY_THROW):
                monitoring.register_callback(self.TOOL, event, self._enter)
            for event in (events.PY_RETURN, events.PY_YIELD, events.PY_UNWIND):
                monitoring.register_callback(self.TOOL, event, self._leave)
        entries = events.PY_START | events.PY_RESUME | events.PY_THROW
        monitoring.set_events(self.TOOL, entries | events.PY_RETURN | events.PY_YIELD | events.PY_UNWIND)

    def _enter(self, code: CodeType, *_: object) -> None:
        if self.paused or not code.co_filename.startswith(self._ours):
            return
        if self._depth == 0:
            self._since, self._entry = self._now(), f"{Path(code.co_filename).name}: {code.co_qualname}"
        self._depth += 1

    def _leave(self, code: CodeType, *_: object) -> None:
        if self._depth == 0 or self.paused or not code.co_filename.startswith(self._ours):
            return
        self._depth -= 1
        if self._depth == 0:
            wait, longest = self._now() - self._since, self.waits.get(self._entry, 0.0)
            self.waits[self._entry] = max(longest, wait)
            self.again[self._entry] = max(self.again.get(self._entry, 0.0), min(longest, wait))

    def _on_collection(self, phase: str, about: dict[str, int]) -> None:
        if about["generation"] == FULL:
            self._collecting += _clock() if phase == "stop" else -_clock()

    def _now(self) -> float:
        """Seconds of the clock without full collections."""
        return _clock() - self._collecting


watch = Watch()
namespace: dict[str, object] = {"bpy": bpy, "watch": watch, "EXTENSION": EXTENSION}
number = 1


def answer_to(question: str) -> dict[str, object]:
    """The answer's file, as JSON has it: `value`, or the traceback as `error`."""
    namespace.pop("answer", None)
    windows = bpy.context.window_manager.windows
    try:
        with bpy.context.temp_override(window=windows[0]) if windows else contextlib.nullcontext():
            try:
                code = compile(question, "<question>", "eval")
            except SyntaxError:
                exec(compile(question, "<question>", "exec"), namespace)
                return {"value": namespace.get("answer")}
            return {"value": eval(code, namespace)}
    except BaseException:
        return {"error": traceback.format_exc()}


def plain(value: object) -> object:
    """What JSON does not know: sequences of Blender's and sets become lists, anything else what `repr` says."""
    try:
        return list(value)  # type: ignore[call-overload]
    except TypeError:
        return repr(value)


def tick() -> float:
    global number
    path = FOLDER / f"{number}.py"
    if path.exists():
        watch.paused = True
        text = json.dumps(answer_to(path.read_text()), default=plain)
        watch.paused = False
        unfinished = FOLDER / f"{number}.tmp"
        unfinished.write_text(text)
        unfinished.replace(FOLDER / f"{number}.json")
        number += 1
    return PAUSE


bpy.context.preferences.view.show_splash = False
bpy.context.preferences.system.viewport_aa = "FXAA"  # the default takes eight times as long, without a graphics card
bpy.app.timers.register(tick, persistent=True)
