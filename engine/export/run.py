"""One export from end to end."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path

from ..errors import PlgsError, lacks_part
from ..job import LiftFolder, verify_lifted, write_atomically
from ..job.progress import Progress, unwatched
from .frame_images import export_coco, export_depth, export_label_images, export_scannet
from .mesh import export_gltf, export_mesh
from .points import export_boxes, export_clouds, export_points, export_splats
from .source import FinishedLift
from .view_surface import export_surface

NOTE = "export.json"  # the file in an export's folder that names its format, its lift and its frames


def export(
    folder: LiftFolder,
    kind: str,
    output: Path,
    frames: Sequence[str],
    *,
    progress: Progress = unwatched,
    cameras: Path | None = None,
    objects: Sequence[str] = (),
    warn: Callable[[str], object] | None = None,
) -> None:
    """Write ``frames`` ("test", "all", names) of a finished lift as ``kind`` (of KINDS) into the folder ``output``.
    With a file of ``cameras``, which only clouds support, write what these see instead. The formats BY_OBJECT can be
    limited to ``objects`` with these names (instances or classes). The folder must be new or empty, or hold this very
    export, complete or not, so that no other files are overwritten; one in the lift's own folder ``exports`` is
    replaced. Raises PlgsError for a lift that is unfinished or damaged, bad cameras, and other files there; OSError."""
    if cameras is not None and kind != "clouds":
        what = f"{kind} can only show the scene's frames"
        raise PlgsError("export-cameras", what, cameras, "Give --frames, or export clouds.", option="--cameras")
    if objects and kind not in BY_OBJECT:
        what = f"{kind} shows whole frames"
        fix = f"Export {', '.join(BY_OBJECT)}, or all objects."
        raise PlgsError("export-objects", what, folder.path, fix, option="--objects")
    if kind == "usd" and find_spec("pxr") is None:
        raise lacks_part("OpenUSD files need the package usd-core", output, "usd")
    folder.refuse_foreign()
    verify_lifted(folder.result_path)
    lift = FinishedLift(folder, frames, progress, cameras, objects, warn)
    shown = [view.name for view in lift.shots] or [frame.name for frame in lift.frames]
    facts = {"form": kind, "lift": str(folder.path), "frames": shown}
    if objects:
        lift.wants(0, 0)  # reports an unknown name before anything is written
        facts["objects"] = [*objects]
    make_room(folder, output, facts)
    KINDS[kind](lift, output)


def make_room(folder: LiftFolder, output: Path, export: Mapping[str, object]) -> None:
    """Create the folder, with the facts of ``export`` in its note. Raises PlgsError for other files in it, OSError."""
    if output.exists() and not output.is_dir():
        raise PlgsError("file-not-folder", "the export needs a folder, but this is a file", output, "Name another one.")
    text, note = json.dumps(export, indent=1) + "\n", output / NOTE
    if output.resolve().is_relative_to(folder.path.resolve() / "exports"):
        shutil.rmtree(output, ignore_errors=True)
    elif output.exists() and any(output.iterdir()) and not (note.is_file() and note.read_bytes() == text.encode()):
        what = "the folder for the export holds other files"
        raise PlgsError("folder-used", what, output, "Name a new or an empty folder.")
    write_atomically(note, text)


def _export_usd(lift: FinishedLift, output: Path) -> None:
    from .usd import export_usd

    export_usd(lift, output)


BY_OBJECT = ("splats", "boxes", "gltf", "usd")  # formats that accept --objects
KINDS: Mapping[str, Callable[[FinishedLift, Path], None]] = {
    "coco": export_coco,
    "instances": export_label_images,
    "scannet": export_scannet,
    "points": export_points,
    "splats": export_splats,
    "boxes": export_boxes,
    "mesh": export_mesh,
    "surface": export_surface,
    "gltf": export_gltf,
    "usd": _export_usd,
    "depth": export_depth,
    "clouds": export_clouds,
}
"""The function that writes each format."""
