"""Drops files on a window as a file manager does: the source's side of the XDND protocol, version 5.

    python3 drag_source.py X Y PATH...

Runs in the tree, with Debian's python3-xlib. The pointer should be at X, Y of the screen already.
"""

from __future__ import annotations

import select
import sys
import time
from pathlib import Path
from typing import Any

from Xlib import X, Xatom, display
from Xlib.protocol import event

VERSION = 5
TIMEOUT_S = 20


class DragSource:
    """One drag, from entering the window to its word that it has taken the files."""

    def __init__(self, paths: list[str]) -> None:
        self._display = display.Display()
        self._root = self._display.screen().root
        self._window = self._root.create_window(0, 0, 1, 1, 0, X.CopyFromParent)
        self._uris = "".join(f"{Path(path).as_uri()}\r\n" for path in paths).encode()

    def drop(self, x: int, y: int) -> None:
        """Carry the files to a point of the screen and let go. RuntimeError or TimeoutError when they are not taken."""
        self._window.set_selection_owner(self._atom("XdndSelection"), X.CurrentTime)
        target, version = self._window_at(x, y)
        self._send(target, "XdndEnter", min(version, VERSION) << 24, self._atom("text/uri-list"))
        self._send(target, "XdndPosition", 0, x << 16 | y, X.CurrentTime, self._atom("XdndActionCopy"))
        if not self._answer("XdndStatus") & 1:
            self._send(target, "XdndLeave")
            raise RuntimeError(f"the window takes no files at {x}, {y}")
        self._send(target, "XdndDrop", 0, X.CurrentTime)
        self._answer("XdndFinished")

    def _window_at(self, x: int, y: int) -> tuple[Any, int]:
        """The outermost window at that point that says that it takes drops, and the newest version that it knows."""
        window = self._root
        while not (aware := window.get_full_property(self._atom("XdndAware"), Xatom.ATOM)):
            window = window.translate_coords(self._root, x, y).child
            if window == X.NONE:
                raise RuntimeError(f"no window at {x}, {y} takes drops")
        return window, int(aware.value[0])

    def _atom(self, name: str) -> int:
        return int(self._display.intern_atom(name))

    def _send(self, target: Any, kind: str, *data: int) -> None:
        content = 32, [self._window.id, *data, *[0] * (4 - len(data))]
        target.send_event(event.ClientMessage(window=target, client_type=self._atom(kind), data=content))
        self._display.flush()

    def _answer(self, kind: str) -> int:
        """Wait for a message of the window's; its flags. Meanwhile the window may ask for the files."""
        end = time.monotonic() + TIMEOUT_S
        while (left := end - time.monotonic()) > 0:
            if not self._display.pending_events():
                select.select([self._display], [], [], left)
                continue
            arrived = self._display.next_event()
            if arrived.type == X.SelectionRequest:
                self._hand_over(arrived)
            elif arrived.type == X.ClientMessage and arrived.client_type == self._atom(kind):
                return int(arrived.data[1][1])
        raise TimeoutError(f"no {kind} of the window within {TIMEOUT_S} s")

    def _hand_over(self, request: Any) -> None:
        request.requestor.change_property(request.property, request.target, 8, self._uris)
        answer = event.SelectionNotify(
            time=request.time, requestor=request.requestor, selection=request.selection, target=request.target,
            property=request.property,
        )  # fmt: skip
        request.requestor.send_event(answer)
        self._display.flush()


if __name__ == "__main__":
    DragSource(sys.argv[3:]).drop(int(sys.argv[1]), int(sys.argv[2]))
