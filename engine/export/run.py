"""One export from end to end."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from ..job import JobError, LiftFolder, read_manifest
from ..passes import PanopticLayers, write_coco
from ..scene import Frame
from .boxes import write_boxes
from .depth_maps import write_depth_maps
from .label_images import write_label_images, write_scannet
from .points import write_points
from .source import FinishedLift


def export(folder: LiftFolder, kind: str, output: Path, frames: Sequence[str], *, count_frames: bool = False) -> None:
    """Write a finished lift as ``kind`` (of KINDS) into the folder ``output``, of ``frames`` ("test", "all", names).
    ``count_frames``: print a line after each.

    Raises JobError for a lift that is not finished or an output that is no folder, SceneError, OSError.
    """
    read_manifest(folder.result_path)
    if output.exists() and not output.is_dir():
        raise JobError("the export needs a folder, this is a file", output, "Name another one.")
    KINDS[kind](FinishedLift(folder, frames, count_frames), output)


def _coco(lift: FinishedLift, output: Path) -> None:
    views = ((frame.name, layers.semantic, layers.instance) for frame, layers in _shown(lift))
    try:
        write_coco(output, lift.classes, views)
    except ValueError as error:
        raise JobError(str(error), output, "Export instances instead: they have 16 bits each.") from error


def _instances(lift: FinishedLift, output: Path) -> None:
    write_label_images(output, _shown(lift), lift.classes, lift.instances)


def _scannet(lift: FinishedLift, output: Path) -> None:
    write_scannet(output, _shown(lift), lift.classes)


def _points(lift: FinishedLift, output: Path) -> None:
    write_points(output, lift.folder, np.array([frame.camera.centre for frame in lift.scene.frames]))


def _boxes(lift: FinishedLift, output: Path) -> None:
    write_boxes(output, lift.records)


def _mesh(lift: FinishedLift, output: Path) -> None:
    from .mesh import write_meshes

    write_meshes(output, _shown(lift), lift.classes, lift.instances)


def _depth(lift: FinishedLift, output: Path) -> None:
    write_depth_maps(output, _shown(lift))


KINDS: Mapping[str, Callable[[FinishedLift, Path], None]] = {
    "coco": _coco,
    "instances": _instances,
    "scannet": _scannet,
    "points": _points,
    "boxes": _boxes,
    "mesh": _mesh,
    "depth": _depth,
}


def _shown(lift: FinishedLift) -> Iterator[tuple[Frame, PanopticLayers]]:
    """The views, counted on standard error where that is a terminal, or where it was asked for."""
    for number, view in enumerate(lift.views(), start=1):
        yield view
        told = f"{number} of {len(lift.frames)} frames"
        if lift.count_frames:
            print(told, file=sys.stderr, flush=True)
        elif sys.stderr.isatty():
            print(f"\r{told}", end="\n" if number == len(lift.frames) else "", file=sys.stderr, flush=True)
