"""What an operator answers Blender: an expected error becomes one line for the user and "cancelled"."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

import bpy

from ..plgs_blender.errors import EXPECTED
from ..plgs_blender.panel_words import in_panel_words

FINISHED, CANCELLED = {"FINISHED"}, {"CANCELLED"}
RUNNING, PASSED_ON = {"RUNNING_MODAL"}, {"PASS_THROUGH"}

Execute = Callable[[Any, bpy.types.Context], set[str]]
Handle = Callable[[Any, bpy.types.Context, bpy.types.Event], set[str]]


def panel_of(context: bpy.types.Context) -> Any | None:
    """The settings of the panel that a button stands in, for `poll`; None for a script, whose arguments count."""
    return getattr(context, "plgs_panel", None)


def reporting(execute: Execute) -> Execute:
    """Decorates an operator's `execute`. Blender counts the arguments, hence the two of them."""

    @wraps(execute)
    def answer(operator: Any, context: bpy.types.Context) -> set[str]:
        try:
            return execute(operator, context)
        except EXPECTED as error:
            operator.report({"ERROR"}, in_panel_words(str(error)))
            return CANCELLED

    return answer


def reporting_events(handle: Handle) -> Handle:
    """Decorates an operator's `invoke` and `modal`."""

    @wraps(handle)
    def answer(operator: Any, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        return reporting(lambda self, now: handle(self, now, event))(operator, context)

    return answer
