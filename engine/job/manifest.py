"""The list of a result's files, result/manifest.json. It is written last, so a result that has one is complete."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from stat import S_ISREG

from .. import __version__
from ..errors import ErrorCode, PlgsError
from ..json_file import Json
from ..records import read_record, record_text
from .atomic import ListedFile, files_below, remove_parts, sha256, write_atomically

_Facts = Mapping[str, Json]
_Names = Mapping[str, str]
NAME = "manifest.json"
_LIFTED = ("model.safetensors", "instances.json")
MAKE_ANEW = "Make the result again: 'python -m engine lift LIFT --resume'."
"""The advice for a result that has changed since it was written."""


def damaged(key: str, what: str, path: Path) -> PlgsError:
    """Return the error ``key`` for the result's file ``path``, which is not as it was written; ``what`` says how."""
    return PlgsError(key, what, path, MAKE_ANEW, code=ErrorCode.DAMAGED, option="--resume")


@dataclass(frozen=True)
class Manifest:
    """What a finished lift made, and how: ``versions`` are those of libraries, ``settings`` all options' final values.
    ``timings`` are seconds by stage. ``frames`` gives the original names of frames whose files are named otherwise, by
    file name. ``masks`` is the digest of the masks that were lifted; "" if unknown. ``request`` is the digest of the
    lift's request.json. ``estimated`` says what was not measured, and licences."""

    engine_version: str
    versions: _Facts
    seed: int
    settings: _Facts
    timings: _Facts
    files: tuple[ListedFile, ...]
    frames: Mapping[str, str] = field(default_factory=dict)
    masks: str = ""
    request: str = ""
    estimated: tuple[str, ...] = ()


def write_manifest(
    result: Path, *, versions: _Facts, seed: int, settings: _Facts, timings: _Facts,
    frames: _Names | None = None, masks: str = "", only: Collection[Path] | None = None, estimated: Sequence[str] = (),
) -> None:  # fmt: skip
    """Write the manifest, which finishes the lift, with the sizes and SHA-256 of the result's files: all, or those in
    ``only``, as others may be somebody else's. ``versions`` are those of libraries, ``settings`` the final values of
    all options; the other arguments are as in `Manifest`."""
    remove_parts(result)
    listed = (path for path in files_below(result) if path != result / NAME and (only is None or path in only))
    files = tuple(ListedFile.of(path, result) for path in listed)
    facts = (versions, seed, settings, timings, files, frames or {}, masks, request_digest(result.parent))
    _write(result, Manifest(__version__, *facts, tuple(estimated)))


def request_digest(lift: Path) -> str:
    """Return the SHA-256 of a lift's request.json; "" without one. Raises OSError."""
    path = lift / "request.json"
    return sha256(path) if path.is_file() else ""


def add_files(result: Path, paths: Sequence[Path], frames: _Names | None = None) -> None:
    """Add new or changed files to the manifest of a finished lift. Its other entries stay. The result is complete
    before and after, even if the process is killed in between. ``frames`` are original names by file name. Raises
    PlgsError without a manifest, OSError."""
    manifest = read_manifest(result)
    files = {file.path: file for file in (*manifest.files, *(ListedFile.of(path, result) for path in paths))}
    names = {**manifest.frames, **(frames or {})}
    _write(result, replace(manifest, files=tuple(files[path] for path in sorted(files)), frames=names))


def drop_files(result: Path, paths: Sequence[Path]) -> None:
    """Take files that are about to be made again out of the manifest of a finished lift; its other entries stay. Raises
    PlgsError without a manifest, OSError."""
    manifest = read_manifest(result)
    dropped = {PurePosixPath(path.relative_to(result)) for path in paths}
    _write(result, replace(manifest, files=tuple(file for file in manifest.files if file.path not in dropped)))


def _write(result: Path, manifest: Manifest) -> None:
    write_atomically(result / NAME, record_text(manifest))


def read_manifest(result: Path) -> Manifest:
    """Read a result's manifest, without checking its files. Raises PlgsError if there is no complete one."""
    path = result / NAME
    if not path.is_file():
        what = "does not exist, so this lift is not finished"
        raise PlgsError("not-finished", what, path, "Resume the lift.", code=ErrorCode.NOT_FINISHED)
    try:
        return read_record(Manifest, path, MAKE_ANEW)
    except PlgsError as error:
        if error.fix != MAKE_ANEW:
            raise
        raise damaged(error.key, error.what, path) from (error.__cause__ or error)


def check_sizes(result: Path) -> Manifest:
    """Return the manifest if every listed file exists with the right size; else raise PlgsError."""
    manifest = read_manifest(result)
    for file in manifest.files:
        path = result / file.path
        try:
            found = path.lstat()
        except OSError as error:
            raise damaged("file-missing", "is missing", path) from error
        except ValueError as error:
            raise damaged("impossible-file", f"lists a file that cannot exist ({error})", result / NAME) from error
        if not S_ISREG(found.st_mode):
            raise damaged("not-a-file", "is not a plain file", path)
        if found.st_size != file.bytes:
            raise damaged("other-bytes", f"has {found.st_size} bytes, but {file.bytes} were written", path)
    return manifest


def verify(result: Path) -> Manifest:
    """Return the manifest if every listed file has its size and SHA-256; else raise PlgsError."""
    manifest = check_sizes(result)
    verify_files(result, manifest.files)
    return manifest


def lifted_digest(manifest: Manifest) -> str:
    """The SHA-256 of a result's model and its objects, which determine its passes; "" without a model."""
    digests = {str(file.path): file.sha256 for file in manifest.files}
    return " ".join(digests[name] for name in _LIFTED) if digests.keys() >= {*_LIFTED} else ""


def verify_of(result: Path, lift: Path) -> None:
    """Raise PlgsError unless the result's files are as its manifest says, and it is of the request of this ``lift``."""
    if verify(result).request != request_digest(lift):
        raise damaged("other-request", "is the result of other options than request.json has", result / NAME)


def verify_lifted(result: Path) -> Manifest:
    """Check files' sizes and, but for passes and previews, SHA-256. Returns the manifest, or raises PlgsError."""
    manifest = check_sizes(result)
    verify_files(result, (file for file in manifest.files if len(file.path.parts) == 1))  # others are in folders
    return manifest


def changed_files(result: Path) -> list[Path]:
    """The files that differ from the manifest; none without a complete one. Raises OSError if one is unreadable."""
    try:
        listed = read_manifest(result).files
    except PlgsError:
        return []
    return [path for file in listed if (path := result / file.path).is_file() and sha256(path) != file.sha256]


def verify_files(result: Path, files: Iterable[ListedFile]) -> None:
    """Raise PlgsError unless the files have the SHA-256 listed for them."""
    for file in files:
        path = result / file.path
        try:
            found = sha256(path)
        except OSError as error:
            raise damaged("unreadable", f"cannot be read ({error.strerror})", path) from error
        if found != file.sha256:
            raise damaged("file-changed", "was changed since it was written", path)
