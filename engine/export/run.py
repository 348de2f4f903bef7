"""Run one export from end to end."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path

from ..errors import ErrorCode, PlgsError, lacks_part
from ..job import LiftFolder, verify_lifted
from ..job.own_files import OwnFiles
from ..job.progress import Progress, unwatched
from .frame_images import export_coco, export_depth, export_label_images, export_scannet
from .mesh import export_gltf, export_mesh
from .points import export_boxes, export_clouds, export_points, export_splats
from .source import FinishedLift
from .view_surface import export_surface


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
    """Write ``frames`` ("test", "all", names) of a finished lift as ``kind`` (one of KINDS) into the folder ``output``.
    With a file of ``cameras``, which only clouds support, write what these see instead. The formats BY_OBJECT can be
    limited to ``objects`` with these names (instances or classes). The folder must be new or empty, or hold this very
    export, complete or not; one in the lift's own folder ``exports`` may hold any export. Only files of the earlier
    export are replaced or deleted; ``warn`` is called with warnings. Raises PlgsError for a lift that is unfinished or
    damaged, bad cameras, and other files there; OSError."""
    if cameras is not None and kind != "clouds":
        what = f"the export {kind} can only show the scene's own frames"
        raise PlgsError("export-cameras", what, cameras, "Give --frames, or export clouds.", option="--cameras")
    if objects and kind not in BY_OBJECT:
        what = f"the export {kind} cannot be limited to objects"
        fix = f"Export {', '.join(BY_OBJECT)}, or leave out --objects."
        raise PlgsError("export-objects", what, folder.path, fix, option="--objects")
    if kind == "usd" and find_spec("pxr") is None:
        raise lacks_part("OpenUSD files need the package usd-core", output, "usd")
    folder.refuse_foreign()
    verify_lifted(folder.result_path)
    read = folder.result_path.stat()
    lift = FinishedLift(folder, frames, progress, cameras, objects, warn)
    shown = [view.name for view in lift.shots] or [frame.name for frame in lift.frames]
    facts = {"form": kind, "lift": str(folder.path), "frames": shown}
    if objects:
        lift.wants(0, 0)  # reports an unknown name before anything is written
        facts["objects"] = [*objects]
    shared = folder.path.resolve() / "exports"
    if output.resolve() == shared:
        what = "is the folder of all exports of the lift; each needs its own"
        raise PlgsError("all-exports", what, output, f"Name a folder in it, such as {output / kind}.", option="-o")
    with OwnFiles(output).begin("export", facts, replaces=output.resolve().is_relative_to(shared)) as own:
        KINDS[kind](lift, output)
        if not folder.result_path.is_dir() or not os.path.samestat(read, folder.result_path.stat()):
            what = "the lift was made again meanwhile, so the export may mix two results"
            raise PlgsError("result-changed", what, folder.path, "Export it again.", code=ErrorCode.BUSY)
        own.remove_earlier()
    own.complete()


def _export_usd(lift: FinishedLift, output: Path) -> None:
    from .usd import export_usd

    export_usd(lift, output)


BY_OBJECT = ("splats", "boxes", "gltf", "usd")  # formats that accept --objects
KINDS: Mapping[str, Callable[[FinishedLift, Path], None]] = {
    "coco": export_coco, "instances": export_label_images, "scannet": export_scannet, "points": export_points,
    "splats": export_splats, "boxes": export_boxes, "mesh": export_mesh, "surface": export_surface,
    "gltf": export_gltf, "usd": _export_usd, "depth": export_depth, "clouds": export_clouds,
}  # fmt: skip
"""The function that writes each format."""
