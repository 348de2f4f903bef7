"""A task is one run of an engine's command that another process follows: where its files are, and how far it is."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path

from ..errors import PlgsError
from ..gates import inner_path, open_plain
from ..json_file import Json
from .events import Event

LIFT, BAKE = "lift", "bake"
"""The kinds of tasks that work in a lift folder. Other kinds have the names of the engine's commands."""
LIVE_PREVIEW = "result/previews/live.png"
"""A picture of the model during training, replaced by rename every few seconds; gone when the lift is finished."""
LOG_LINES = 40
"""The number of lines at a log's end that hold a Python traceback, or what a crash in native code leaves."""
LOG_BYTES = 1 << 16
"""At most this many bytes at a log's end are read for them."""
_LONGEST_LINE = 500
_MOST = 1 << 62
"""No count and no number of seconds is larger."""
_NO_LINK: int = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)


class TaskState(StrEnum):
    RUNNING = "running"
    FINISHED = "finished"
    CANCELLED = "cancelled"
    FAILED = "failed"


@dataclass(frozen=True)
class TaskPlace:
    """The three files that a task shares with its follower: its ``events``, the ``cancel`` file that stops it, and its
    ``log``. ``arguments`` tell a command to use them; a lift's are those of its folder, which the command knows.
    ``folder`` is a temporary one that goes with the task.
    """

    events: Path
    cancel: Path
    log: Path
    arguments: tuple[str | Path, ...] = ()
    folder: Path | None = None

    @classmethod
    def of_lift(cls, lift: Path) -> TaskPlace:
        """The files of a lift folder."""
        return cls(lift / "events.jsonl", lift / "cancel", lift / "log.txt")

    @classmethod
    def at(cls, events: Path) -> TaskPlace:
        """The files beside ``events``, whose name ends in .jsonl. Raises PlgsError for one that a task cannot have."""
        events = events.absolute()
        if events.suffix != ".jsonl" or not events.parent.is_dir():
            fix = "Give --events a name that ends in .jsonl, in a folder that is there."
            raise PlgsError("the events cannot be written there", events, fix, option="--events")
        return cls(events, events.with_suffix(".cancel"), events.with_suffix(".log"), ("--events", events))

    @classmethod
    def temporary(cls, parent: Path | None = None) -> TaskPlace:
        """Files in a new folder that only this user may read, in the system's temporary folder unless ``parent`` is
        given. `discard` removes it. Raises OSError.
        """
        place = cls.at(Path(tempfile.mkdtemp(prefix="plgs-task-", dir=parent)) / "events.jsonl")
        return replace(place, folder=place.events.parent)

    def ask_to_cancel(self) -> None:
        """Make the cancel file: the engine stops at its next step. A link is not followed. Raises OSError."""
        os.close(os.open(self.cancel, os.O_WRONLY | os.O_CREAT | _NO_LINK, 0o666))

    def discard(self) -> None:
        """Delete the files of a task that has ended. Raises OSError."""
        if self.folder is not None:
            shutil.rmtree(self.folder, ignore_errors=True)
            return
        for path in (self.events, self.cancel, self.log):
            path.unlink(missing_ok=True)

    def last_lines(self, count: int = LOG_LINES) -> tuple[str, ...]:
        """The last ``count`` lines of the log that are not blank, cut at 500 characters; none without a log."""
        return last_lines(self.log, count)


@dataclass
class TaskProgress:
    """How far a run is. ``stage_index`` counts from 1; ``step`` of ``steps`` of this stage are done, ``eta_s`` seconds
    of it remain, and ``left_s`` of the whole run, if known. ``began`` is when the run began, in Unix seconds.

    ``live_preview`` is a picture of the growing model. Its content was replaced ``live_previews`` times, the last time
    as seen by the camera with the fingerprint ``live_preview_camera``. ``previews`` are the pictures that stay.
    """

    stage: str = ""
    label: str = "Starting"
    stage_index: int = 0
    stage_count: int = 0
    step: int = 0
    steps: int = 0
    loss: float | None = None
    eta_s: float | None = None
    left_s: float | None = None
    metrics: dict[str, Mapping[str, Json]] = field(default_factory=dict)
    artifacts: list[tuple[str, Path]] = field(default_factory=list)
    previews: list[Path] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    live_preview: Path | None = None
    live_previews: int = 0
    live_preview_camera: str = ""
    began: float | None = None

    def take(self, event: Event, folder: Path) -> None:
        """Update the progress with an event. ``folder`` holds the events; the paths in them are relative to it."""
        data = event.data
        match event.kind:
            case "stage":
                self.stage, self.label = str(data["name"]), str(data["label"])
                self.stage_index, self.stage_count = _int(data["index"]), _int(data["count"])
                self.step, self.steps, self.loss, self.eta_s = 0, 0, None, None
            case "progress":
                self.step, self.steps = _int(data["step"]), _int(data["steps"])
                self.loss, self.eta_s = _float(data.get("loss")), _float(data.get("eta_s"))
                self.left_s = _float(data.get("left_s"))
            case "metric":
                values = data["values"]
                self.metrics[str(data["name"])] = values if isinstance(values, dict) else {}
            case "artifact" if path := _inside(data["path"], folder):
                self.artifacts.append((str(data["kind"]), path))
            case "preview" if data["path"] == LIVE_PREVIEW:
                self.live_preview = folder / LIVE_PREVIEW
                self.live_previews += 1
                self.live_preview_camera = str(data.get("camera", ""))
            case "preview" if path := _inside(data["path"], folder):
                self.previews.append(path)
            case "warning":
                self.warnings.append(str(data["message"]))


def last_lines(log: Path, count: int = LOG_LINES) -> tuple[str, ...]:
    """The last ``count`` lines of a log's last 64 KB that are not blank, cut at 500 characters; none without a log.

    Each version of a line that was overwritten repeatedly, such as a progress bar, counts.
    """
    try:
        with open_plain(log, follow_link=False) as file:
            start = max(0, os.fstat(file.fileno()).st_size - LOG_BYTES)
            file.seek(start)
            content = file.read(LOG_BYTES)
    except OSError:  # never begun, or deleted
        return ()
    lines = content.decode("utf-8", errors="replace").splitlines()
    told = [line.rstrip()[:_LONGEST_LINE] for line in lines[1 if start else 0 :] if line.strip()]
    return tuple(told[-count:])


def _inside(path: Json, folder: Path) -> Path | None:
    """The path, or None if it leads out of the folder, as someone else may have written the event."""
    try:
        return folder / inner_path(str(path))
    except ValueError:
        return None


def _int(value: Json) -> int:
    """The number, or 0 for anything that is not a valid count."""
    return value if isinstance(value, int) and 0 <= value <= _MOST else 0


def _float(value: Json) -> float | None:
    """The number, or None for NaN, infinity, anything that is not a number, and anything too large."""
    if not isinstance(value, int | float) or not -_MOST <= value <= _MOST:
        return None
    return float(value)
