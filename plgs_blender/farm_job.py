"""A camera's bake as a job for a render farm: what Flamenco's manager accepts for the job type of farm/plgs.js."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import bpy

from ..engine.errors import PlgsError
from ..engine.job import LiftFolder, write_atomically
from .shots import Shot

JOB = "farm.json"
_CHUNK = 50
"""Frames that one task of the farm bakes."""
_PLATFORMS = {"win32": "windows", "darwin": "darwin"}


def write_farm_job(scene: bpy.types.Scene, lift: LiftFolder, shot: Shot) -> Path:
    """Write the job that bakes a shot of the scene, of a finished lift, into the lift's folder, and return the file.
    The farm reads the camera from this .blend, as last saved. Raises PlgsError if it never was, OSError.
    """
    blend = bpy.data.filepath
    if not blend:
        fix = "Save it where the farm can read it, then try again."
        raise PlgsError("the farm reads the camera from a file, and this one has no name", scene.name, fix)
    frames = shot.frames
    settings = {
        "scene": str(lift.request.scene),
        "output": str(lift.path),
        "preset": lift.request.preset,
        "lift_options": "",
        "lifted": True,
        "bake": "camera",
        "blend": blend,
        "camera": shot.camera.name,
        "shot": shot.given,
        "frames": f"{frames[0]}-{frames[-1]}" if shot.step == 1 else ",".join(map(str, frames)),
        "chunk_size": _CHUNK,
        "layers": " ".join(sorted(scene.plgs.layers)),
    }
    job = {
        "name": f"{lift.path.name}: {shot.camera.name}",
        "type": "plgs",
        "priority": 50,
        "submitter_platform": _PLATFORMS.get(sys.platform, "linux"),
        "settings": settings,
    }
    path = lift.path / "bake" / JOB
    path.parent.mkdir(exist_ok=True)
    write_atomically(path, json.dumps(job, indent=2) + "\n")
    return path
