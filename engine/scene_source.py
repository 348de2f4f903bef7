"""Which scene is meant, and how it is read: what commands, requests and the panel pass on.

A field's metadata holds the keywords of `argparse` for the ``option`` of the command line that sets it.
"""

from __future__ import annotations

from argparse import ArgumentTypeError
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

UpAxis = Literal["z", "y", "-y", "+z"]
UPS: tuple[str, ...] = get_args(UpAxis)
UP_OPTIONS: dict[str, UpAxis] = {"auto": "z", "z": "+z", "y": "y", "-y": "-y"}
"""What --up may be, and what it means."""


def option(help: str, metavar: str, type: Any = str, **more: Any) -> dict[str, Any]:
    """The metadata of a field that an option of the command line sets."""
    return {"option": {"help": help, "metavar": metavar, "type": type, **more}}


def up_axis(text: str) -> str:
    """What --up means; for argparse, so it raises ArgumentTypeError."""
    if text not in UP_OPTIONS:
        raise ArgumentTypeError(f"{text!r} is not one of {',  '.join(UP_OPTIONS)}")
    return UP_OPTIONS[text]


def class_table(text: str) -> str:
    """The name of a table of classes as it is, the path of a file as an absolute one."""
    return str(Path(text).resolve()) if text.endswith(".toml") else text


@dataclass(frozen=True)
class SceneSource:
    """``scene`` is its folder or file; the rest says how it is read.

    ``masks`` names panoptic masks outside the folder. ``up`` is the axis of the poses' world that points up; "z" leaves
    it to formats that know, "+z" is the z axis whatever they say. ``scene_format`` and ``mask_format`` name formats
    that are recognised otherwise. ``depth`` is a folder of monocular depth maps in place of the scene's depth.
    ``classes`` is the name of a table of the masks' classes, or the path of a .toml file.
    """

    scene: Path
    masks: Path | None = field(default=None, metadata=option("panoptic masks, if not in SCENE itself", "PATH", Path))
    up: UpAxis = field(
        default="z",
        metadata=option(
            "the axis of the poses that points up (default: auto, what the format says, else z)",
            "|".join(UP_OPTIONS),
            up_axis,
        ),
    )
    scene_format: str | None = field(
        default=None,
        metadata=option(
            "how SCENE is laid out, such as colmap, nerfstudio, polycam, tum (default: recognised by its files)", "NAME"
        ),
    )
    depth: Path | None = field(
        default=None, metadata=option("depth maps of a network, fitted to the scene's sparse points", "FOLDER", Path)
    )
    mask_format: str | None = field(
        default=None,
        metadata=option(
            "how the masks are laid out, such as coco, transformers, sam2, pairs (default: recognised by their files)",
            "NAME",
        ),
    )
    classes: str | None = field(
        default=None,
        metadata=option(
            "the masks' classes, or one of coco, ade20k, cityscapes, nyu40, nyu13, scannet, scannet200, replica, "
            "reduced, or with its numbering, such as ade20k:1-150 or coco:90 (default: classes.toml beside them)",
            "FILE.toml",
            class_table,
        ),
    )

    @property
    def up_option(self) -> str:
        """What --up has to be for this ``up``."""
        return next(option for option, up in UP_OPTIONS.items() if up == self.up)

    @property
    def resolved(self) -> SceneSource:
        """The same with absolute paths without links."""
        masks, depth = (None if path is None else path.resolve() for path in (self.masks, self.depth))
        classes = None if self.classes is None else class_table(self.classes)
        return SceneSource(self.scene.resolve(), masks, self.up, self.scene_format, depth, self.mask_format, classes)
