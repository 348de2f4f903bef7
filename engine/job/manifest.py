"""result/manifest.json: written last, so a result that has one is complete."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from stat import S_ISREG

from .. import __version__
from ..gates import inner_path
from .atomic import files_below, remove_parts, sha256, write_atomically
from .errors import JobError
from .json_file import Json, read_object, to_text

FORMAT = 1
NAME = "manifest.json"
MAKE_ANEW = "Resume the lift: 'python -m engine lift LIFT --resume' makes the result anew."
"""What to do about a result that is not as it was written."""


@dataclass(frozen=True)
class ResultFile:
    """One file of the result: its path relative to result/, its size and its checksum."""

    path: PurePosixPath
    bytes: int
    sha256: str


@dataclass(frozen=True)
class Manifest:
    """What a finished lift made and how. ``timings``: stage name to seconds."""

    engine_version: str
    versions: Mapping[str, Json]
    seed: int
    settings: Mapping[str, Json]
    timings: Mapping[str, Json]
    files: tuple[ResultFile, ...]


def write_manifest(
    result: Path,
    *,
    versions: Mapping[str, str],
    seed: int,
    settings: Mapping[str, object],
    timings: Mapping[str, float],
) -> None:
    """List every file of the result with size and SHA-256. The lift is finished when this returns.

    ``versions``: library name to version; ``settings``: what the preset and the overrides came to, JSON
    types.
    """
    remove_parts(result)
    files = [_entry(path, result) for path in files_below(result) if path != result / NAME]
    content = {
        "format": FORMAT,
        "engine_version": __version__,
        "versions": versions,
        "seed": seed,
        "settings": settings,
        "timings": timings,
        "files": files,
    }
    write_atomically(result / NAME, to_text(content))


def add_files(result: Path, paths: Sequence[Path]) -> None:
    """List more files, or changed ones, in the manifest of a finished lift; the rest of it stays as it is.

    The result is whole before and after, and whenever a kill comes between. Raises JobError when there is no manifest,
    OSError.
    """
    read_manifest(result)  # refuses what this version does not know
    content = read_object(result / NAME, MAKE_ANEW)
    entries = {str(entry["path"]): entry for entry in _objects(content["files"])}
    entries |= {str(entry["path"]): entry for entry in (_entry(path, result) for path in paths)}
    content["files"] = [entries[path] for path in sorted(entries, key=PurePosixPath)]
    write_atomically(result / NAME, to_text(content))


def drop_files(result: Path, paths: Sequence[Path]) -> None:
    """List files no more that are about to be made anew. Otherwise as ``add_files``."""
    read_manifest(result)
    content = read_object(result / NAME, MAKE_ANEW)
    dropped = {path.relative_to(result).as_posix() for path in paths}
    content["files"] = [entry for entry in _objects(content["files"]) if entry["path"] not in dropped]
    write_atomically(result / NAME, to_text(content))


def _entry(path: Path, result: Path) -> dict[str, Json]:
    return {"path": path.relative_to(result).as_posix(), "bytes": path.stat().st_size, "sha256": sha256(path)}


def _objects(value: Json) -> list[dict[str, Json]]:
    return [each for each in value if isinstance(each, dict)] if isinstance(value, list) else []


def read_manifest(result: Path) -> Manifest:
    """The manifest of a result folder; files are not looked at. Raises JobError when none is whole."""
    path = result / NAME
    if not path.is_file():
        raise JobError("is not there, so this lift is not finished", path, "Resume the lift.")
    content = read_object(path, MAKE_ANEW)
    if content.get("format") != FORMAT:
        what = f"has format {content.get('format')!r}, this version reads {FORMAT}"
        raise JobError(what, path, "Use the version of PLGS that wrote it, or lift into another folder.")
    try:
        return _manifest(content)
    except (KeyError, TypeError, ValueError) as error:
        raise JobError(f"is damaged ({error!r})", path, MAKE_ANEW) from error


def check_sizes(result: Path) -> Manifest:
    """The manifest, after a look whether every file it lists is there in the right size. Raises JobError."""
    manifest = read_manifest(result)
    for file in manifest.files:
        path = result / file.path
        try:
            found = path.lstat()
        except OSError as error:
            raise JobError("is missing", path, MAKE_ANEW) from error
        except ValueError as error:
            raise JobError(f"lists a file that cannot be ({error})", result / NAME, MAKE_ANEW) from error
        if not S_ISREG(found.st_mode):
            raise JobError("is no plain file", path, MAKE_ANEW)
        if found.st_size != file.bytes:
            raise JobError(f"has {found.st_size} bytes, {file.bytes} were written", path, MAKE_ANEW)
    return manifest


def verify(result: Path) -> Manifest:
    """The manifest, after comparing every file with size and SHA-256. Raises JobError."""
    manifest = check_sizes(result)
    verify_files(result, manifest.files)
    return manifest


def verify_lifted(result: Path) -> Manifest:
    """The manifest, after `check_sizes` and the SHA-256 of what was lifted: of all but passes and previews, which may
    be very many. Raises JobError."""
    manifest = check_sizes(result)
    verify_files(result, (file for file in manifest.files if len(file.path.parts) == 1))
    return manifest


def changed_files(result: Path) -> list[Path]:
    """Files that are there, and are not as the manifest lists them; none where no whole manifest says how they were.
    Raises OSError when one cannot be read, which says nothing about what it holds."""
    try:
        listed = read_manifest(result).files
    except JobError:
        return []
    return [path for file in listed if (path := result / file.path).is_file() and sha256(path) != file.sha256]


def verify_files(result: Path, files: Iterable[ResultFile]) -> None:
    """Compare files with the SHA-256 that the manifest has of them. Raises JobError."""
    for file in files:
        path = result / file.path
        try:
            found = sha256(path)
        except OSError as error:
            raise JobError(f"cannot be read ({error.strerror})", path, MAKE_ANEW) from error
        if found != file.sha256:
            raise JobError("was changed since it was written", path, MAKE_ANEW)


def _manifest(content: Mapping[str, Json]) -> Manifest:
    """Raises KeyError, TypeError or ValueError when something is missing or of the wrong type."""
    mappings: dict[str, Mapping[str, Json]] = {}
    for name in ("versions", "settings", "timings"):
        value = content[name]
        if not isinstance(value, dict):
            raise TypeError(f"{name} is no object")
        mappings[name] = value
    files, seed = content["files"], content["seed"]
    if not isinstance(files, list) or not isinstance(seed, int):
        raise TypeError("files or seed has the wrong type")
    return Manifest(
        str(content["engine_version"]),
        mappings["versions"],
        seed,
        mappings["settings"],
        mappings["timings"],
        tuple(_result_file(entry) for entry in files),
    )


def _result_file(entry: Json) -> ResultFile:
    if not isinstance(entry, dict) or not isinstance(entry["bytes"], int):
        raise TypeError(f"{entry!r} is no file entry")
    path = inner_path(str(entry["path"]))
    return ResultFile(path, entry["bytes"], str(entry["sha256"]))
