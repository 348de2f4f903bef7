"""The formats of scenes: one reader each, which recognises its files by their names and reads posed pictures.

A new format's ``SceneFormat`` goes into ``FORMATS``, and its name into ``engine/scene_source.py``."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from ...errors import ErrorCode, PlgsError, reading
from ...posed.layout import listed, shown, shown_files
from . import (
    arkitscenes,
    bundler,
    colmap,
    hypersim,
    metashape,
    nerfstudio,
    phone_apps,
    reality,
    record3d,
    replica,
    scannet,
    scannetpp,
    seven_scenes,
)
from .capture import Capture, SceneFormat, Shot
from .photos import CONVERT, LET_COLMAP, finished_models, is_film, photos_in
from .tum import FORMAT as TUM

FORMATS: tuple[SceneFormat, ...] = (
    scannet.FOLDERS, nerfstudio.FORMAT, colmap.FORMAT, TUM, seven_scenes.FORMAT, replica.FORMAT, scannet.SENS,
    phone_apps.POLYCAM, record3d.FORMAT, phone_apps.STRAY, phone_apps.SCANNER_APP, scannetpp.FORMAT, hypersim.FORMAT,
    arkitscenes.FORMAT, metashape.FORMAT, reality.FORMAT, bundler.FORMAT,
)  # fmt: skip

_EXPORT_SCAN = (
    "Export the scan itself: Record3D's .r3d or EXR + JPG sequence, Polycam's Raw Data, 3D Scanner App's All Data, or "
    "Stray Scanner's folder."
)
_RTABMAP = (
    "Export with rtabmap-export --images --poses_camera --poses_format 11, rename the poses to groundtruth.txt, and "
    "write fx fy cx cy of calib into calibration.txt."
)
_OTHER_PHOTOS = {".heic", ".heif", ".avif", ".webp", ".tif", ".tiff", ".dng", ".cr2", ".cr3", ".nef", ".arw"}
_LOOKED_INTO = 100  # maximum number of subfolders searched for scenes if a folder holds none itself
_UNPACK = "python -m zipfile -e FILE FOLDER"


def find_format(place: Path, name: str | None = None) -> SceneFormat:
    """Return the format called ``name``, or the one that recognises the folder or file ``place``. Plain folders come
    before others, as they often also hold what they were made from. Raises PlgsError for an unknown name, and if none
    of the others, or more than one, recognises it."""
    if not place.exists():
        raise PlgsError("no-folder", "the folder does not exist", place, "Name the folder of a scene.")
    known = {each.name: each for each in FORMATS}
    if name is not None:
        if name not in known:
            fix = f"Choose one of {', '.join(known)}."
            raise PlgsError("unknown-format", f'no format is called "{shown(name)}"', place, fix, option="--format")
        return known[name]
    with reading(place, "Check its permissions."):
        found = [each for each in FORMATS if each.recognises(place)]
    if len(found) > 1 and found[0] is not FORMATS[0]:
        names = " and ".join(each.name for each in found)
        fix = f"Say which one it is, such as --format {found[0].name}."
        raise PlgsError("several-formats", f"this looks like {names}", place, fix, option="--format")
    if not found:
        raise _unknown(place, known)
    return found[0]


def _unknown(place: Path, known: Iterable[str]) -> PlgsError:
    what, film, models = "there is no scene of a known format here", is_film(place), finished_models(place)
    if models:
        app = "Scaniverse exports no such data. " if any("scaniverse" in name.lower() for name in models) else ""
        what = f"there are finished models only ({listed(models)}), without the scan's pictures, depth and poses"
        return PlgsError("models-only", what, place, f"{app}{_EXPORT_SCAN}")
    if place.suffix.lower() == ".zip" and place.is_file():
        return PlgsError("archive", "this is an archive", place, f"Unpack it ({_UNPACK}), and name the folder.")
    if place.is_dir() and (place / "rgb").is_dir() and any(shown_files(place, "*_poses.txt")):
        return PlgsError("rtabmap", "these are RTAB-Map's poses, but not in a layout that PLGS reads", place, _RTABMAP)
    entries = sorted(shown_files(place)) if place.is_dir() else []
    if photos := [each.name for each in entries if each.suffix.lower() in _OTHER_PHOTOS]:
        what = f"these photos are no JPEGs or PNGs ({listed(photos)})"
        fix = "Convert them (phones: Settings > Camera > Most Compatible)."
        return PlgsError("photos-of-another-kind", what, place, fix)
    folders = [each for each in entries if each.is_dir() and os.access(each, os.R_OK | os.X_OK)][:_LOOKED_INTO]
    if inner := [each for each in folders if any(known.recognises(each) for known in FORMATS)]:
        fix = f"Name one of them, such as {inner[0]}, or lift all: python -m engine batch {place}/* -o OUT."
        what = f"this folder itself is not a scene, but holds {listed([each.name for each in inner])}"
        return PlgsError("inner-scenes", what, place, fix)
    if (place / "request.json").is_file():
        return PlgsError("lift-as-scene", "this is a lift, not a scene", place, "Name the scene that was lifted.")
    has_photos = place.is_dir() and photos_in(place) is not None
    has_depth, has_poses = (any(word in each.name.lower() for each in entries) for word in ("depth", "pose"))
    if has_poses and (has_photos or has_depth):
        what = "there are poses, but not in a layout that PLGS reads"
        return PlgsError("loose-folders", what, place, f"{CONVERT} Or {LET_COLMAP}.")
    if film or has_photos:
        fix = (
            f"{'A film needs' if film else 'Photos need'} poses: record with an app that keeps them (Record3D, "
            f"Polycam, Stray Scanner), or {LET_COLMAP}."
        )
        return PlgsError("no-poses", what, place, fix, code=ErrorCode.NO_POSES)
    fix = f"{CONVERT} Or name a layout to see what it lacks: --format {', '.join(known)}."
    return PlgsError("no-format", what, place, fix, option="--format")
