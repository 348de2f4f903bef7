"""corrections.json: the edits of a lift, in the order in which they were made.

No edit is ever taken out: one that was undone says so. Writers take turns, and each writes what it has just read, so
two Blenders that edit one lift lose nothing.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from ..errors import ErrorCode, PlgsError
from ..job import write_atomically
from ..job.lock import lock_on
from ..json_file import read_object, take_objects, take_whole_number, to_text
from .edits import CORRECTIONS, Edit, edit_of

FORMAT = 1
_MEND = "Mend it, or move it away to see the lift as the engine made it."
_WAIT_S = 20.0


def read_edits(lift: Path) -> tuple[Edit, ...]:
    """The edits of the lift in this folder, the undone ones too; none where there is no file.

    Raises PlgsError when the file is damaged, or of a later version: then nobody shows or changes anything by it.
    """
    path = lift / CORRECTIONS
    if not path.exists():
        return ()
    content = read_object(path, _MEND)
    version = take_whole_number(content, "format", "the file", path)
    if version != FORMAT:
        fix = "Use the version of PLGS that wrote it: nothing of it was changed."
        raise PlgsError(f"has format {version}, this version reads {FORMAT}", path, fix)
    edits = tuple(edit_of(entry, path) for entry in take_objects(content, "edits", "the file", path))
    if len({edit.uid for edit in edits}) < len(edits):
        raise PlgsError("two edits have the same uid", path, _MEND)
    return edits


@contextmanager
def editing(lift: Path) -> Iterator[list[Edit]]:
    """The edits, to be changed within ``with``; then they are written. Others wait meanwhile.

    Raises PlgsError when the file cannot be read or is busy, OSError. Then nothing is written.
    """
    folder = lift / "bake"
    folder.mkdir(exist_ok=True)
    try:
        lock = lock_on(folder / "corrections.lock", _WAIT_S, brief=True).__enter__()
    except PlgsError as error:
        if error.code is not ErrorCode.BUSY:
            raise
        fix = "Try again in a moment."
        raise PlgsError("another program edits this lift", lift / CORRECTIONS, fix, code=ErrorCode.BUSY) from error
    try:
        before = read_edits(lift)
        edits = list(before)
        yield edits
        if tuple(edits) != before:
            write_edits(lift, edits)
    finally:
        lock.__exit__(None, None, None)


def write_edits(lift: Path, edits: Sequence[Edit]) -> None:
    """Write all edits, by rename. For whoever holds the lock, or has just made the folder. Raises OSError."""
    content = {"format": FORMAT, "edits": [edit.to_json() for edit in edits]}
    write_atomically(lift / CORRECTIONS, to_text(content))
