"""corrections.json: the edits of a lift, in the order in which they were made.

No edit is ever removed: an undone edit is marked as undone. Writers take turns, and each writes what it has just read,
so two Blenders that edit the same lift lose nothing.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..errors import ErrorCode, PlgsError
from ..job import write_atomically
from ..job.lock import FileLock
from ..json_file import read_object, take_objects, take_whole_number, to_text
from .edits import CORRECTIONS, MEND, Edit, edit_of

FORMAT = 1
_WAIT_S = 20.0


def read_edits(lift: Path) -> tuple[Edit, ...]:
    """The edits of the lift in this folder, including undone ones; none where there is no file.

    Raises PlgsError when the file is damaged or from a later version; its edits are then neither shown nor changed.
    """
    path = lift / CORRECTIONS
    if not path.exists():
        return ()
    content = read_object(path, MEND)
    version = take_whole_number(content, "format", "the file", path)
    if version != FORMAT:
        fix = "Use the version of PLGS that wrote it. The file was not changed."
        raise PlgsError(f"the file has format {version}, but this version reads {FORMAT}", path, fix)
    edits = tuple(edit_of(entry, path) for entry in take_objects(content, "edits", "the file", path))
    if len({edit.uid for edit in edits}) < len(edits):
        raise PlgsError("two edits have the same uid", path, MEND)
    return edits


@contextmanager
def editing(lift: Path) -> Iterator[list[Edit]]:
    """The edits, to be changed inside the ``with`` block and written at its end. Other writers wait until then.

    Raises PlgsError when the file cannot be read or is busy, and OSError. Nothing is then written.
    """
    folder = lift / "bake"
    folder.mkdir(exist_ok=True)
    try:
        with FileLock(folder / "corrections.lock", _WAIT_S):
            before = read_edits(lift)
            edits = list(before)
            yield edits
            if tuple(edits) != before:
                content = {"format": FORMAT, "edits": [edit.to_json() for edit in edits]}
                write_atomically(lift / CORRECTIONS, to_text(content))
    except PlgsError as error:
        if error.code is not ErrorCode.BUSY:
            raise
        fix = "Try again in a moment."
        raise PlgsError("another program is editing this lift", lift / CORRECTIONS, fix, code=ErrorCode.BUSY) from error
