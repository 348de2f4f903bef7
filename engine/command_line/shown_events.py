"""The events of a command that no other process follows, as a person sees them."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TextIO

from ..gates import printable
from ..job import Event, EventWriter
from ..job.task import TaskProgress
from ..job.terminal import LiveLine
from ..json_file import to_line


class ShownEvents(EventWriter):
    """Events of a command that no other process follows: progress is shown on ``stream``, and the answer is printed on
    standard output, as one line of JSON or as text.
    """

    def __init__(self, stream: TextIO, *, as_json: bool) -> None:
        self._folder, self._as_json = Path(), as_json
        self._line, self._progress = LiveLine(stream), TaskProgress()

    def answer(self, answer: Mapping[str, object], text: str = "") -> None:
        self._line.end()
        sys.stdout.flush()
        said = (
            (printable(text) + "\n").encode(errors="backslashreplace")
            if text and not self._as_json
            else to_line(answer)
        )
        sys.stdout.buffer.write(said)  # UTF-8 on every system, as a path may need
        sys.stdout.flush()

    def close(self) -> None:
        self._line.end()

    def _write(self, event: str, /, **data: Any) -> None:
        if event == "warning":
            self._line.say(f"warning: {data['message']}")
        elif event in ("stage", "progress"):
            self._progress.take(Event(0, 0.0, event, data), self._folder)
            if event == "progress":
                self._line.show(self._progress)
        else:
            self._line.end()


class ShownWarnings(EventWriter):
    """Events in a file, of a command that no other process follows: warnings are shown on ``stream``, too."""

    def __init__(self, path: Path, echo: int | None, stream: TextIO) -> None:
        super().__init__(path, echo)
        self._stream = stream

    def warning(self, message: str) -> None:
        super().warning(message)
        print(f"warning: {printable(message)}", file=self._stream)
