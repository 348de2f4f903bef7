"""What is wrong with a scene, as an engine measures it in a process of its own: its findings, read from what it writes.

The panel draws from here; nothing is read while it draws.
"""

from __future__ import annotations

import json
import shutil
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ..engine.job import ExitCode, JobError
from ..engine.job.process import EngineProcess, engine_call
from .scene_survey import Place

_FINDINGS = "findings.json"


@dataclass(frozen=True)
class Finding:
    """One finding: its ``cause`` in a word or two, what is wrong with its figures, what mends it, and its picture.

    ``is_wrong``: it should be mended before a lift; else it is a note. ``is_mended``: "Fix" mends it.
    """

    cause: str
    text: str
    option: str
    is_wrong: bool
    is_mended: bool
    picture: Path | None


@dataclass(frozen=True)
class SceneDiagnosis:
    """What is known of a scene. While an engine measures (``is_running``) nothing else is. ``error`` says why there are
    no findings. ``mended`` is the folder that "Fix" writes.
    """

    place: Place
    is_running: bool = False
    findings: tuple[Finding, ...] = ()
    looked: int = 0
    frames: int = 0
    can_be_mended: bool = False
    error: str | None = None
    mended: Path | None = None


_latest: SceneDiagnosis | None = None
_engine: EngineProcess | None = None
_folder: Path | None = None


def diagnosis_of(place: Place) -> SceneDiagnosis | None:
    """What is known of this scene; None when nobody has measured yet."""
    return _latest if _latest is not None and _latest.place == place else None


def begin(place: Place, python: Path, mended: Path | None = None) -> SceneDiagnosis:
    """Let an engine measure the scene, and with ``mended`` write it there with what is safe mended.

    Raises JobError when no engine can be started.
    """
    global _latest, _engine, _folder
    forget()
    _folder = Path(tempfile.mkdtemp(prefix="plgs-findings-"))
    command = [*engine_call(python), "inspect", *place.arguments(), "--json", "--stay-with-parent", "-o", _folder]
    command += [] if mended is None else ["--fix", mended]
    try:
        _engine = EngineProcess(command)
    except JobError:
        forget()
        raise
    _latest = SceneDiagnosis(place, is_running=True, mended=mended)
    return _latest


def is_running() -> bool:
    """Whether an engine measures just now."""
    return _engine is not None


def poll() -> SceneDiagnosis | None:
    """The diagnosis when it has just come, else None."""
    global _latest, _engine
    if _engine is None or _latest is None:
        return None
    code = _engine.exit_code()
    if code is None:
        return None
    output = _engine.output_tail()
    _engine.close()
    _engine = None
    _latest = _with_answer(replace(_latest, is_running=False), code, output)
    return _latest


def forget() -> None:
    """End a measurement that goes on, and let go of findings and their pictures."""
    global _latest, _engine, _folder
    if _engine is not None:
        _engine.kill()
        _engine.close()
        _engine = None
    if _folder is not None:
        shutil.rmtree(_folder, ignore_errors=True)
        _folder = None
    _latest = None


def _with_answer(diagnosis: SceneDiagnosis, code: int, output: str) -> SceneDiagnosis:
    """The diagnosis with what the engine wrote. A scene that a lift refuses has findings too, which say why."""
    line = output.splitlines()[-1] if output else "no answer"
    error = line.removeprefix("error: ") if code != ExitCode.FINISHED else None
    mended = diagnosis.mended if diagnosis.mended is not None and diagnosis.mended.is_dir() else None
    path = None if _folder is None else _folder / _FINDINGS
    if path is None or not path.is_file():
        return replace(diagnosis, error=error or "the engine wrote no findings", mended=mended)
    try:
        answer = json.loads(path.read_text(encoding="utf-8"))
        return replace(
            diagnosis,
            findings=tuple(_finding(entry, path.parent) for entry in answer["findings"]),
            looked=int(answer["looked"]),
            frames=int(answer["frames"]),
            can_be_mended=bool(answer["can_be_mended"]),
            error=error,
            mended=mended,
        )
    except (OSError, ValueError, TypeError, KeyError) as problem:
        return replace(diagnosis, error=f"the findings cannot be read ({problem!r})", mended=mended)


def _finding(entry: dict[str, Any], folder: Path) -> Finding:
    picture = entry.get("picture")
    return Finding(
        cause=str(entry["cause"]),
        text=str(entry["text"]),
        option=str(entry["option"]),
        is_wrong=entry["severity"] == "wrong",
        is_mended=bool(entry["is_mended"]),
        picture=None if picture is None else folder / str(picture),
    )
