"""One export from end to end."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from ..job import JobError, LiftFolder, verify_lifted, write_atomically
from ..passes import PanopticLayers, write_coco
from ..scene import Frame
from .boxes import write_boxes
from .depth_maps import write_depth_maps
from .label_images import write_label_images, write_scannet
from .points import write_points
from .source import FinishedLift

NOTE = "export.json"
"""What an export's folder is of: form, lift and frames."""


def export(folder: LiftFolder, kind: str, output: Path, frames: Sequence[str], *, count_frames: bool = False) -> None:
    """Write a finished lift as ``kind`` (of KINDS) into the folder ``output``, of ``frames`` ("test", "all", names).
    ``count_frames``: print a line after each.

    The folder is new or empty, or holds this very export, cut off or whole: nobody's files are written over. What lies
    in the lift's own folder ``exports`` is made anew.

    Raises JobError for a lift that is not finished or is damaged, or an output of another kind, SceneError, OSError.
    """
    verify_lifted(folder.result_path)
    lift = FinishedLift(folder, frames, count_frames)
    make_room(folder, output, {"form": kind, "lift": str(folder.path), "frames": [frame.name for frame in lift.frames]})
    KINDS[kind](lift, output)


def make_room(folder: LiftFolder, output: Path, export: Mapping[str, object]) -> None:
    """A folder for ``export``, whose note says what is in it. Raises JobError where other files are, OSError."""
    if output.exists() and not output.is_dir():
        raise JobError("the export needs a folder, this is a file", output, "Name another one.")
    text, note = json.dumps(export, indent=1) + "\n", output / NOTE
    if output.resolve().is_relative_to(folder.path.resolve() / "exports"):
        shutil.rmtree(output, ignore_errors=True)
    elif output.exists() and any(output.iterdir()) and not (note.is_file() and note.read_bytes() == text.encode()):
        raise JobError("the folder for the export holds other files", output, "Name a new or an empty folder.")
    write_atomically(note, text)


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
