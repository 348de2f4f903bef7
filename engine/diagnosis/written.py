"""A diagnosis on disk: findings.json and a picture a finding."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Any

from ..job.atomic import PART, write_atomically
from ..scene import SceneError
from .finding import Diagnosis, Finding

FINDINGS = "findings.json"


def write_findings(diagnosis: Diagnosis, folder: Path) -> None:
    """Write findings.json and the pictures that it names into a folder: a new or empty one, or one of earlier findings.

    Raises SceneError.
    """
    try:
        if folder.exists() and any(folder.iterdir()) and not _is_of_findings(folder):
            raise SceneError("the folder for the findings holds other files", folder, "Name a new or an empty folder.")
        folder.mkdir(parents=True, exist_ok=True)
        entries = []
        for number, finding in enumerate(diagnosis.findings, start=1):
            entry = finding.as_json()
            if finding.picture is not None:
                entry["picture"] = f"{number}-{finding.cause.replace(' ', '-')}.png"
                write_atomically(folder / entry["picture"], _png(finding))
            entries.append(entry)
        write_atomically(folder / FINDINGS, json.dumps({**as_json(diagnosis), "findings": entries}, indent=1))
    except OSError as error:
        what = f"the findings cannot be written ({error.strerror or error})"
        raise SceneError(what, os.fspath(error.filename or folder), "Choose another folder.") from error


def _is_of_findings(folder: Path) -> bool:
    """Whether all that is there are findings and their pictures ("1-depth-unit.png"), or what a kill left of them."""
    names = [path.name.removeprefix(PART) for path in folder.iterdir()]
    return all(name == FINDINGS or re.fullmatch(r"\d+-[a-z-]+\.png", name) for name in names)


def as_json(diagnosis: Diagnosis) -> dict[str, Any]:
    """A diagnosis for programs, without the pictures."""
    views = diagnosis.agreement
    return {
        "frames": diagnosis.frames,
        "looked": diagnosis.looked,
        "agreement": None if views is None else {"seen": views.seen, "share": views.share, "error": views.error},
        "can_be_mended": diagnosis.mending.is_needed,
        "findings": [finding.as_json() for finding in diagnosis.findings],
    }


def _png(finding: Finding) -> bytes:
    import cv2

    written, encoded = cv2.imencode(".png", finding.picture[..., ::-1])  # type: ignore[index]
    if not written:
        raise OSError(0, "a picture cannot be encoded")
    return encoded.tobytes()
