"""Exports of finished lifts: each an engine of its own that writes and ends. Knows nothing of Blender.

Like `lifts` they live in the module and are polled; only one runs at a time.
"""

from __future__ import annotations

import re
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ...engine.job import JobError
from ...engine.job.process import EngineProcess, engine_call

FORMS = {
    "coco": ("COCO panoptic", "panoptic.json and PNGs of segments"),
    "instances": ("Label images", "16-bit PNGs of classes and instances, and in colours"),
    "scannet": ("ScanNet labels", "label-filt, instance-filt and their table"),
    "points": ("Labelled points", "PLY of the semantic points, and of the Gaussians"),
    "boxes": ("Boxes", "The objects' oriented boxes as JSON and CSV"),
    "mesh": ("Meshes", "The surface as PLY, and a GLB for each instance and each stuff class"),
    "depth": ("Depth maps", "The lifted surface's depth as 16-bit PNGs in millimetres"),
}
"""What the engine exports to: a label and what it is."""
_PROGRESS = re.compile(r"(\d+) of (\d+) frames")
_POLL_S = 0.05


@dataclass
class Export:
    """One export. ``error`` is None while it goes on, and when it ended well."""

    form: str
    output: Path
    process: EngineProcess
    done: int = 0
    total: int = 0
    ended: bool = False
    cancelled: bool = False
    error: str | None = None

    @property
    def message(self) -> str:
        """One line for people."""
        label = FORMS[self.form][0]
        if not self.ended:
            return f"Exporting {label}"
        if self.cancelled:
            return "The export was cancelled"
        return self.error or f"{label} are in {self.output}"

    def poll(self) -> bool:
        """Take in what happened; whether anything did."""
        if self.ended:
            return False
        code, before = self.process.exit_code(), self.done
        lines = [line for line in self.process.output_tail().splitlines() if line.strip()]
        counted = [found for line in lines if (found := _PROGRESS.search(line))]
        if counted:
            self.done, self.total = int(counted[-1][1]), int(counted[-1][2])
        if code is not None:
            self.ended = True
            if code != 0 and not self.cancelled:
                said = lines[-1].removeprefix("error: ") if lines else ""
                self.error = said or f"the export ended without a message (exit code {code})"
            self.process.close()
        return self.ended or self.done != before

    def cancel(self) -> None:
        """End it; what was written so far stays."""
        self.cancelled = True
        self.process.kill()


_latest: list[Export] = []


def latest() -> Export | None:
    """The export that was started last."""
    return _latest[-1] if _latest else None


def is_running() -> bool:
    return bool(_latest) and not _latest[-1].ended


def start(lift: Path, form: str, output: Path, python: Path, frames: Sequence[str] = ("all",)) -> Export:
    """Start an export of a finished lift into the folder ``output``. Raises JobError, OSError."""
    if is_running():
        raise JobError("another export is running", _latest[-1].output, "Wait for it, or cancel it first.")
    _latest[:] = [Export(form, output, EngineProcess(export_command(python, lift, form, output, frames)))]
    return _latest[0]


def export_command(python: Path, lift: Path, form: str, output: Path, frames: Sequence[str]) -> list[str | Path]:
    """The command that exports a lift and counts the frames."""
    what: list[str | Path] = [lift, "--to", form, "-o", output, "--frames", *frames]
    return [*engine_call(python), "export", *what, "--progress", "--stay-with-parent"]


def poll() -> bool:
    """Whether there is news."""
    return bool(_latest) and _latest[-1].poll()


def wait_for(export: Export) -> None:
    """Block until it has ended; Ctrl-C ends it."""
    try:
        while not export.ended:
            export.poll()
            time.sleep(_POLL_S)
    except KeyboardInterrupt:
        export.cancel()
        export.poll()
        raise


def let_go() -> None:
    """End what runs, and forget it."""
    if is_running():
        _latest[-1].cancel()
        _latest[-1].poll()
    _latest.clear()
