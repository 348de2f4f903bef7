"""Kernels are compiled, or loaded, before the first pass that needs them; the log says so when that takes long.

A process that only draws waits for the forward pass alone. Where both passes have yet to be compiled, a second process
takes the backward one.
"""

from __future__ import annotations

from collections.abc import Callable

from .announcing import is_compiled, note_compiled, say_that_it_compiles
from .companion import Companion, has_room_for_two
from .undisturbed import undisturbed


class WarmUp:
    """Of one set of kernels, which the log calls the ``whole``, in one process. ``compile_forward`` and
    ``compile_backward`` call every kernel of their pass once; ``apart`` is the module that does the latter in a process
    of its own."""

    def __init__(
        self, whole: str, compile_forward: Callable[[], None], compile_backward: Callable[[], None], apart: str
    ) -> None:
        self._whole = whole
        self._forward, self._backward = (f"the {way} pass of {self._whole}" for way in ("forward", "backward"))
        self._compile_forward, self._compile_backward, self._apart = compile_forward, compile_backward, apart
        self._has_forward = self._has_backward = False
        self._has_spoken = False
        self._companion: Companion | None = None

    def forward(self, backward_follows: bool) -> None:
        """Before a forward pass."""
        if self._has_forward:
            return
        if backward_follows and not is_compiled(self._forward) and not is_compiled(self._backward):
            say_that_it_compiles(self._whole, "15 s")
            self._has_spoken = True
            if has_room_for_two():
                self._companion = Companion(self._apart)
        elif not is_compiled(self._forward):
            say_that_it_compiles(self._forward, "8 s")
        undisturbed(self._compile_forward)
        note_compiled(self._forward)
        self._has_forward = True

    def backward(self) -> None:
        """Before a backward pass."""
        if self._has_backward:
            return
        if self._companion is not None:
            self._companion.wait()
        if not self._has_spoken and not is_compiled(self._backward):
            say_that_it_compiles(self._backward, "8 s")
        undisturbed(self._compile_backward)
        note_compiled(self._backward)
        self._has_backward = True
