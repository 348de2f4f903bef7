"""The note of a shot beside its cameras: whose it is, and what it shows. So a bake overwrites another file's shot, or
an earlier state of its own, only if it is told to."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from glob import escape
from pathlib import Path

from ..engine.corrections import read_corrected
from ..engine.errors import PlgsError
from ..engine.job import read_manifest, write_atomically
from ..engine.job.lock import FileLock
from ..engine.job.manifest import NAME as MANIFEST
from ..engine.job.manifest import lifted_digest
from ..engine.posed.layout import listed
from ..engine.records import read_record, record_text
from .shot_names import VERSION

_NOTE_FIX = "Delete it, if no other file bakes a shot of this name."
_CLAIM_S = 10.0  # seconds to wait while another bake claims a shot


@dataclass(frozen=True)
class ShotSource:
    """What a shot shows: a ``camera`` of the file ``blend`` (unsaved: its Blender's temporary folder), and the
    fingerprints of the camera by names of ``frames``; the ``lift``'s name, the digest of its ``model`` and objects, its
    ``corrections``, and the rate ``fps``. Notes of version 0.1.0 end with ``frames``."""

    blend: str
    camera: str
    frames: dict[str, str] = field(default_factory=dict)
    lift: str = ""
    model: str = ""
    corrections: str = ""
    fps: float | None = None

    @property
    def origin(self) -> tuple[str, str]:
        """The file, without its version number, and the camera."""
        return VERSION.sub("", self.blend), self.camera

    def of_lift(self, lift: Path) -> ShotSource:
        """Return this source with the facts about ``lift`` filled in; unchanged if that is not finished. Raises
        PlgsError for damage."""
        if not (lift / "result" / MANIFEST).is_file():
            return self
        model, corrected = lifted_digest(read_manifest(lift / "result")), read_corrected(lift)
        return dataclasses.replace(self, lift=lift.name, model=model, corrections=corrected.fingerprint)

    def changed_from(self, earlier: ShotSource) -> str:
        """Return what differs from an ``earlier`` state of the shot, in words; "" if nothing does."""
        if earlier.model and earlier.model != self.model:
            return f"the lift is another result, {self.lift} instead of {earlier.lift}"
        if earlier.model and earlier.corrections != self.corrections:
            return "the lift's corrections have changed"
        if earlier.fps is not None and earlier.fps != self.fps:
            return f"the rate is {self.fps:g} instead of {earlier.fps:g}"
        changed = [frame for frame, seen in self.frames.items() if earlier.frames.get(frame, seen) != seen]
        return f"the camera or its size has changed in {len(changed)} frames, such as {changed[0]}" if changed else ""


@dataclass(frozen=True)
class Claim:
    """A bake's claim on a shot: the path of its note, the note's text ``before`` ("": there was none) and since then,
    and the files and folders ``made`` by the bake. Frames ``left`` of a replaced shot still show its earlier state."""

    path: Path
    before: str
    text: str
    made: Sequence[Path]
    left: tuple[str, ...] = ()

    def withdraw(self) -> None:
        """Leave all as it was, unless another bake has claimed more frames since then. Raises OSError if that fails."""
        lock = self.path.with_suffix(".lock")
        with FileLock(lock, _CLAIM_S):
            if self.path.read_text(encoding="utf-8") != self.text:
                return
            if self.before:
                write_atomically(self.path, self.before)
            for path in self.made:
                if path.is_file() and path != lock:
                    path.unlink()
        for path in self.made:
            if path.is_dir():
                path.rmdir()
            else:
                path.unlink(missing_ok=True)


def claim(folder: Path, name: str, source: ShotSource, *, cameras: Path, passes: Path, replaces: bool) -> Claim:
    """Record in a folder which shot has this ``name`` and what it shows; ``cameras`` is the file of its cameras,
    ``passes`` the folder of its views. Raises PlgsError if a bake would overwrite another shot, or the same shot with
    another content, unless it ``replaces`` that."""
    path, before, left = _note(folder, name), "", tuple[str, ...]()
    lock = path.with_suffix(".lock")
    made = [each for each in (path, cameras, lock, folder, *folder.parents) if not each.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    alike = [each.name for each in folder.glob("*.shot.json") if each.name.casefold() == path.name.casefold()]
    if alike and path.name not in alike:
        what = f"has a shot whose name differs from {name!r} only in capitals, which Windows and macOS ignore"
        raise PlgsError("shot-taken", what, folder, "Give this one another name with --shot.", option="--shot")
    with FileLock(lock, _CLAIM_S):  # others may begin to bake the same shot
        if path.exists():
            other = read_record(ShotSource, path, _NOTE_FIX)
            if not any(passes.glob(f"{escape(name)}.*.exr")):  # nothing that a new result or rate would overwrite
                other = dataclasses.replace(other, model="", fps=None)
            if not replaces:
                _refuse_other(folder, name, other, source)
            if source.changed_from(dataclasses.replace(other, frames={})):
                left = tuple(frame for frame in other.frames if frame not in source.frames)
            else:
                source = dataclasses.replace(source, frames=other.frames | source.frames)
            before = path.read_text(encoding="utf-8")
        text = record_text(source)
        if text != before:
            write_atomically(path, text)
    return Claim(path, before, text, made, left)


def next_version(folder: Path, earlier: str, name: str) -> list[str]:
    """Return lines: why ``name`` is the next version of ``earlier``, and frames that it lacks. Raises PlgsError."""
    before, now = (read_record(ShotSource, _note(folder, each), _NOTE_FIX) for each in (earlier, name))
    lacking = [frame for frame in before.frames if frame not in now.frames]
    lines = [f"{name} is the next version of {earlier}: {now.changed_from(before)}"]
    return lines + ([f"{earlier} has frames that {name} lacks: {listed(lacking)}"] if lacking else [])


def _note(folder: Path, name: str) -> Path:
    return folder / f"{name}.shot.json"


def _refuse_other(folder: Path, name: str, other: ShotSource, source: ShotSource) -> None:
    if other.origin != source.origin:
        whose = "another camera of this file" if other.origin[0] == source.origin[0] else "another file"
        what = f"has a shot {name!r} of {whose} already: camera {other.camera!r} in {other.blend}"
        fix = "Give this one another name with --shot, or replace the other one with --replace."
        raise PlgsError("shot-taken", what, folder, fix, option="--shot --replace")
    if changed := source.changed_from(other):
        what = f"has the shot {name!r} already, and {changed}"
        fix = "Name the next version with --shot, as {version} in its name does, or replace this one with --replace."
        raise PlgsError("shot-changed", what, folder, fix, option="--shot --replace")
