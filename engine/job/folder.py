"""The lift folder: the only thing that the engine and Blender share. It may contain no links, FIFOs or devices, as a
lift may come from someone else: if its log were a link, resuming it would append to the link's target."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from enum import Enum
from itertools import count
from pathlib import Path
from stat import S_ISDIR, S_ISLNK, S_ISREG

from ..errors import ErrorCode, ExitCode, PlgsError, is_silence, reading
from ..gates import create_plain
from ..presets.preset import PRESETS
from .atomic import PART, files_below, flush_to_disk, remove_parts, write_atomically
from .checkpoint import CheckpointStore
from .events import last_events
from .lock import BakeLocks, FileLock, is_locked
from .manifest import changed_files, check_sizes, verify, verify_of
from .request import LiftRequest, PresetName, refuse_unwritable_name
from .task import LIVE_PREVIEW, TaskFiles


class LiftState(Enum):
    """The state of a lift. It can be resumed in every state except RUNNING and FINISHED."""

    NOT_STARTED = "not started"
    RUNNING = "running"
    INTERRUPTED = "interrupted"  # its engine was killed, or the power was cut
    CANCELLED = "cancelled"
    FAILED = "failed"
    FINISHED = "finished"


NEXT = "result.next"
"""Where a finished lift is lifted again. Its result stays complete until the new one is."""


class _Inside:
    """A property: the path ``name`` inside the folder that the LiftFolder's attribute ``where`` holds."""

    def __init__(self, where: str, name: str) -> None:
        self._where, self._name = where, name

    def __get__(self, folder: LiftFolder, kind: type) -> Path:
        inside: Path = getattr(folder, self._where) / self._name
        return inside


@dataclass(frozen=True)
class LiftFolder:
    """A folder with a readable request.json, and the name of its result's folder. Get one from `create` or `open`."""

    path: Path
    request: LiftRequest
    result_name: str = "result"

    @classmethod
    def create(cls, path: Path, request: LiftRequest) -> LiftFolder:
        """Make the folder and write its request. An empty folder is accepted, anything else is refused. Raises
        PlgsError if the folder is not empty or cannot be written."""
        path = path.absolute()
        refuse_unwritable_name(path)
        try:
            path.mkdir(parents=True, exist_ok=True)
            refuse_used(path)
            _write_new(path / "request.json", request.to_json(path))
        except FileExistsError as error:
            fix = "Choose another output folder."
            raise PlgsError("in-the-way", "already exists", error.filename or path, fix) from error
        except OSError as error:
            fix = "Choose a folder that you can write to, on a disk with free space."
            raise PlgsError("unwritable", f"cannot be written ({error.strerror})", path, fix) from error
        except ValueError as error:
            fix = "Choose another output folder."
            raise PlgsError("bad-path", f"cannot be the path of a folder ({error})", repr(str(path)), fix) from error
        return cls(path, request)

    @classmethod
    def open(cls, path: Path) -> LiftFolder:
        """Open a lift folder. Raises PlgsError if it is none, if a file is a link, or if its request is unreadable."""
        path = path.absolute()
        refuse_unwritable_name(path)
        try:
            is_folder = path.is_dir()
        except OSError as error:  # a name that is too long, a disk that does not answer
            what = f"cannot be opened ({error.strerror})"
            raise PlgsError("unopenable", what, path, "Give the folder of a lift.") from error
        if not is_folder:
            raise PlgsError("no-lift-folder", "there is no such lift folder", path, "Give the folder of a lift.")
        refuse_foreign(path)
        if not (path / "request.json").is_file():
            what = "is not a lift folder (it has no request.json)"
            raise PlgsError("not-lift-folder", what, path, "Give the folder of a lift.")
        return cls(path, LiftRequest.read(path / "request.json"))

    def asked_again(self, request: LiftRequest) -> LiftFolder:
        """Return this lift for a command that requests it again, perhaps now with ``anyway``. Raises PlgsError if the
        request differs in anything else, and OSError."""
        differing = request.differences(self.request)
        if differing:
            fix = "Leave these options as they were, or choose another output folder."
            raise PlgsError("other-options", f"holds a lift with a different {', '.join(differing)}", self.path, fix)
        if not request.anyway or self.request.anyway:
            return self
        asked = replace(self.request, anyway=True)
        write_atomically(self.path / "request.json", asked.to_json(self.path))
        return LiftFolder(self.path, asked)

    def refined(self, preset: PresetName) -> LiftFolder:
        """Replace the lift's preset by a better one, with which the next run continues. Its result stays until there is
        a new one. Raises PlgsError if the lift's preset is better already, or an engine is at work here; OSError."""
        with self.lock():
            order, request = list(PRESETS), LiftRequest.read(self.path / "request.json")
            if order.index(preset) < order.index(request.preset):
                what, fix = f"was lifted by {request.preset}, which is better than {preset}", "Name a better preset."
                raise PlgsError("not-finer", what, self.path, fix, option="--refine")
            if preset != request.preset:
                request = replace(request, preset=preset)
                write_atomically(self.path / "request.json", request.to_json(self.path))
        return LiftFolder(self.path, request)

    @property
    def task_files(self) -> TaskFiles:
        """The files that the lift's engine shares with processes that follow it."""
        return TaskFiles.of_lift(self.path)

    @property
    def result_path(self) -> Path:
        return self.path / self.result_name

    events_path = _Inside("path", "events.jsonl")
    cancel_path = _Inside("path", "cancel")
    log_path = _Inside("path", "log.txt")
    training_path = _Inside("path", "training.csv")  # the losses of every step
    preview_request_path = _Inside("path", "preview.json")  # the camera that the user wants to see (see `cameras`)
    live_preview_path = _Inside("path", LIVE_PREVIEW)
    manifest_path = _Inside("result_path", "manifest.json")
    passes_path = _Inside("result_path", "passes")
    previews_path = _Inside("result_path", "previews")

    @property
    def checkpoints(self) -> CheckpointStore:
        return CheckpointStore(self.path)

    @property
    def is_running(self) -> bool:
        return is_locked(self.events_path)

    def lock(self) -> FileLock:
        """The engine's lock, held while it writes. ``with`` raises PlgsError if another engine has it, and OSError."""
        return FileLock(self.events_path)

    def refuse_foreign(self) -> None:
        """Raise PlgsError if a lift's file is a link or of a kind that no lift has. Call it before writing."""
        refuse_foreign_below(self.path)

    def refuse_read_only(self) -> None:
        """Raise PlgsError, before any work starts, if nothing can be written here."""
        if not os.access(self.path, os.W_OK | os.X_OK):  # X_OK: to reach the files in a folder
            fix = "Copy the lift to a place that you can write to, and use the copy."
            raise PlgsError("read-only", "this lift is read-only", self.path, fix)

    def state(self) -> LiftState:
        """Return the lift's state. Raises PlgsError if the file system does not support locks."""
        return LiftState.RUNNING if self.is_running else self.state_at_rest()

    def state_at_a_glance(self) -> LiftState:
        """The lift's state for a list or a timer: a result counts if it has a manifest, and its files are not checked.
        Takes a millisecond, however large the lift. Raises PlgsError if the file system does not support locks."""
        if self.is_running:
            return LiftState.RUNNING
        is_finished = self.manifest_path.is_file() and not self.is_lifted_again
        return LiftState.FINISHED if is_finished else self._how_it_ended()

    def state_at_rest(self) -> LiftState:
        """Return the lift's state for a caller that knows that no other engine is at work. A result without a complete
        manifest does not count, whatever the events say. A lift that is being lifted again, and has only its earlier
        result, is not finished."""
        return LiftState.FINISHED if self.has_result() and not self.is_lifted_again else self._how_it_ended()

    def _how_it_ended(self) -> LiftState:
        """Return the state of a lift that is neither running nor finished."""
        events = last_events(self.events_path)
        if not events:
            return LiftState.NOT_STARTED
        kinds = {event.kind for event in events}
        if "error" in kinds:
            return LiftState.FAILED
        last = events[-1]
        if last.kind == "done" and last.data.get("state") == "cancelled":
            return LiftState.CANCELLED
        return LiftState.INTERRUPTED  # also after a "finished" whose result is gone

    def last_exit_code(self) -> int | None:
        """The exit code in the error event of the latest run; None without such an event."""
        codes = [event.data.get("exit_code") for event in last_events(self.events_path) if event.kind == "error"]
        return codes[-1] if codes and isinstance(codes[-1], int) else None

    def is_whole(self) -> bool:
        """Whether the lift is finished and its result exactly as it was written. It reads every byte."""
        return self._passes(verify)

    def prepare_run(self) -> None:
        """Delete what an earlier run left: its cancel file, incomplete files, an unfinished new result, and of a
        damaged result the manifest and the files that differ from it. The lift's own files are made again; passes that
        were baked later are not. A complete result stays until there is a new one (see `with_next_result`). Only the
        engine that holds the lock may call this. Raises PlgsError while passes are being baked, before anything is
        deleted, and OSError if a file cannot be read: it stays."""
        was_begun = self.is_lifted_again
        if self.has_result():
            (self.path / NEXT).mkdir(exist_ok=True)  # before the check, so that a bake that begins now sees it
        if BakeLocks(self.path).others_at_work():
            if not was_begun:
                self.drop_next_result()
            fix = "Wait until the bake is done, or cancel it."
            raise PlgsError("being-baked", "passes of this lift are being baked", self.path, fix, code=ErrorCode.BUSY)
        self.cancel_path.unlink(missing_ok=True)
        changed = changed_files(self.result_path)
        for path in changed:
            path.unlink()
        if changed or not self.has_result():
            self.drop_next_result()
            self.manifest_path.unlink(missing_ok=True)  # only now, as `changed_files` reads it
        for path in files_below(self.path / NEXT):
            path.unlink()
        remove_parts(self.path)

    @property
    def is_lifted_again(self) -> bool:
        """Whether the lift has a result and an engine began a new one that is not finished."""
        return (self.path / NEXT).is_dir()

    def with_next_result(self) -> LiftFolder:
        """Return this folder for an engine that writes a result: a new one beside the old one if it is lifted again."""
        return replace(self, result_name=NEXT) if self.is_lifted_again else self

    def drop_next_result(self) -> None:
        """Delete an unfinished new result. Only the engine that holds the lock may call this."""
        if self.is_lifted_again:
            shutil.rmtree(self.path / NEXT)

    def adopt_next_result(self) -> Path | None:
        """Replace the result by a finished new one, also if a kill interrupted this before. The new one must be
        complete by its manifest, and of this lift's request. Returns where the earlier result is now; None if it was
        deleted, or if there is no new one. Only the engine with the lock may call this. Raises OSError, and PlgsError
        if the disk does not answer."""
        new = self.with_next_result()
        if new is self or not new._passes(lambda result: verify_of(result, self.path)):
            return None
        earlier = self.set_result_aside()
        new.result_path.rename(self.result_path)
        return earlier

    def set_result_aside(self) -> Path | None:
        """Move the result into `EARLIER`, as the next one has other objects, and return where it is now. A result
        without passes and without other people's files is deleted instead, and None returned. Raises OSError."""
        if not self.result_path.is_dir():
            return None
        listed = check_sizes(self.result_path).files if self.has_result() else ()
        lifted = {self.manifest_path, *(self.result_path / each.path for each in listed if each.path.suffix != ".exr")}
        if lifted.issuperset(files_below(self.result_path)):
            shutil.rmtree(self.result_path)
            return None
        candidates = (self.path / EARLIER / str(number) for number in count(1))
        earlier = next(earlier for earlier in candidates if not earlier.exists())
        earlier.parent.mkdir(exist_ok=True)
        self.result_path.rename(earlier)
        return earlier

    def prepare_bake(self) -> None:
        """Delete an earlier run's cancel file and incomplete files; the result stays. While another process is baking,
        nothing is deleted, as the files may be its own. Only the engine that holds the lock may call this."""
        if BakeLocks(self.path).others_at_work():
            return
        self.cancel_path.unlink(missing_ok=True)
        remove_parts(self.path)

    def came_to_nothing(self) -> bool:
        """Whether no engine got as far as a checkpoint: it never started, or it refused the input."""
        if not self.path.is_dir():  # someone deleted it during the lift, as the error says
            return False
        if self.is_running or self.checkpoints.exists:
            return False
        state = self.state_at_rest()
        return state is LiftState.NOT_STARTED or (
            state is LiftState.FAILED and self.last_exit_code() == ExitCode.BAD_INPUT
        )

    def discard(self) -> None:
        """Delete a lift that never started, so that the same command can be given again. Only for the caller that has
        just created it. Raises PlgsError if it holds something that took time to make."""
        self.refuse_foreign()
        with FileLock(self.events_path, wait_s=0.0):  # no engine begins in the meantime
            self._discard()
        self.events_path.unlink(missing_ok=True)  # now that it is closed, as Windows cannot delete an open file
        if not any(self.path.iterdir()):
            self.path.rmdir()

    def _discard(self) -> None:
        if self.checkpoints.exists or self.has_result():
            raise PlgsError("finished-work", "holds finished work", self.path, "Resume the lift, or delete it.")
        (self.path / "request.json").unlink()  # first, as a folder without it is not a lift
        for name in DISCARDED:
            (self.path / name).unlink(missing_ok=True)
        for folder in (self.result_path, self.path / "bake"):
            if folder.is_dir():
                shutil.rmtree(folder)
        remove_parts(self.path)

    def has_result(self) -> bool:
        """Whether there is a result. Raises PlgsError if the disk does not answer: a result may still be there."""
        return self._passes(check_sizes)

    def _passes(self, check: Callable[[Path], object]) -> bool:
        try:
            check(self.result_path)
        except PlgsError as error:
            if is_silence(error):
                raise
            return False
        return True


def refuse_used(path: Path) -> None:
    """Raise PlgsError if something is at a path, so that no lift can be made there; OSError if that is unknown."""
    if not path.exists():
        return
    if not path.is_dir():
        raise PlgsError("in-the-way", "is not a folder", path, "Choose another output folder.")
    if (path / "request.json").exists():
        fix = "Add --resume to continue it, or choose another output folder."
        raise PlgsError("holds-lift", "already holds a lift", path, fix, option="--resume")
    for entry in path.iterdir():
        if not entry.name.startswith(PART):  # a kill while a lift folder is made leaves such a name
            what = f"is not empty (it holds '{entry.name}') and is not a lift folder"
            raise PlgsError("folder-used", what, path, "Choose another output folder.")


def _write_new(path: Path, text: str) -> None:
    """Write a complete file under a new name; only one of two processes succeeds. Raises FileExistsError."""
    part = path.with_name(f"{PART}{os.getpid()}-{path.name}")
    try:
        with create_plain(part) as file:
            file.write(text.encode())
        flush_to_disk(part)
        try:
            os.link(part, path)  # unlike a rename, it never replaces a file
        except FileExistsError:
            raise
        except OSError:  # a file system without links
            if path.exists():
                raise FileExistsError(None, "exists", str(path)) from None
            os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


DISCARDED = ("request.json", "scene.json", "preview.json", "training.csv", "cancel", "log.txt")
FILES = (*DISCARDED, "corrections.json", "events.jsonl")
EARLIER = "earlier"
"""The folder, within a lift's folder, for earlier results."""
FOLDERS = ("result", NEXT, "bake", "checkpoint", "checkpoint.next", "checkpoint.old", EARLIER, "exports")


def refuse_foreign(lift: Path, *more: str) -> None:
    """Raise PlgsError if one of a lift's files or folders, or of ``more`` files in it, is a link or the like."""
    for name in (*FILES, *more):
        _refuse(lift / name, S_ISREG)
    for name in FOLDERS:
        _refuse(lift / name, S_ISDIR)


def refuse_foreign_below(lift: Path, folders: Sequence[str] = FOLDERS) -> None:
    """Raise PlgsError if anything in the lift's ``folders`` is a link or the like, before anything changes there."""
    if folders is FOLDERS:
        refuse_foreign(lift)
    tops = [lift / name for name in folders]
    tops += [path for path in _entries(lift) if path.name.startswith(PART)]  # `remove_parts` deletes these
    while tops:
        path = tops.pop()
        _refuse(path, lambda mode: S_ISREG(mode) or S_ISDIR(mode))
        tops += _entries(path)


def _entries(folder: Path) -> list[Path]:
    """Return the entries of a folder; none if it is not a folder, or no longer exists."""
    with reading(folder, "Check its permissions and its disk."), suppress(FileNotFoundError, NotADirectoryError):
        return [*folder.iterdir()]
    return []


def _refuse(path: Path, is_right: Callable[[int], bool]) -> None:
    try:
        mode = os.lstat(path).st_mode  # of a link itself, not of its target
    except (FileNotFoundError, NotADirectoryError):
        return
    except OSError as error:
        fix = "Check its permissions and its disk."
        raise PlgsError("not-examined", f"cannot be examined ({error.strerror})", path, fix) from error
    if not is_right(mode):
        kind = "a link" if S_ISLNK(mode) else "neither a file nor a folder"
        what = f"is {kind}, which no lift or batch puts here"
        raise PlgsError("foreign-file", what, path, "Do not trust the folder. Copy only files you recognise.")
