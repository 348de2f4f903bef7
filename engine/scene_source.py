"""Which scene is meant, and how it is read: what commands, requests and the panel hand on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from .json_file import Json

UpAxis = Literal["z", "y", "-y", "+z"]
UPS: tuple[str, ...] = get_args(UpAxis)
UP_OPTIONS: dict[str, UpAxis] = {"auto": "z", "z": "+z", "y": "y", "-y": "-y"}
"""What --up may be, and what it means."""


@dataclass(frozen=True)
class SceneSource:
    """``scene`` is its folder or file; the rest says how it is read.

    ``masks`` names panoptic masks outside the folder. ``up`` is the axis of the poses' world that points up; "z" leaves
    it to formats that know, "+z" is the z axis whatever they say. ``scene_format`` and ``mask_format`` name formats
    that are recognised otherwise. ``depth`` is a folder of monocular depth maps in place of the scene's depth.
    ``classes`` is the name of a table of the masks' classes, or the path of a .toml file.
    """

    scene: Path
    masks: Path | None = None
    up: UpAxis = "z"
    scene_format: str | None = None
    depth: Path | None = None
    mask_format: str | None = None
    classes: str | None = None

    @property
    def up_option(self) -> str:
        """What --up has to be for this ``up``."""
        return next(option for option, up in UP_OPTIONS.items() if up == self.up)

    @property
    def resolved(self) -> SceneSource:
        """The same by absolute paths without links."""
        masks, depth = (None if path is None else path.resolve() for path in (self.masks, self.depth))
        classes = None if self.classes is None else class_table(self.classes)
        return SceneSource(self.scene.resolve(), masks, self.up, self.scene_format, depth, self.mask_format, classes)

    def as_json(self) -> dict[str, Json]:
        named = {"mask_format": self.mask_format, "classes": self.classes}
        return {
            "scene": str(self.scene),
            "masks": None if self.masks is None else str(self.masks),
            "up": self.up,
            "scene_format": self.scene_format,
            "depth": None if self.depth is None else str(self.depth),
            **{name: value for name, value in named.items() if value is not None},
        }

    @classmethod
    def from_json(cls, given: Mapping[str, Any]) -> SceneSource:
        """The source that `as_json` gave. Raises KeyError, TypeError."""
        masks, depth = (None if given[name] is None else Path(given[name]) for name in ("masks", "depth"))
        named = (given.get(name) for name in ("mask_format", "classes"))
        return SceneSource(Path(given["scene"]), masks, given["up"], given["scene_format"], depth, *named)


def class_table(text: str) -> str:
    """The name of a table of classes as it is, the path of a file as an absolute one."""
    return str(Path(text).resolve()) if text.endswith(".toml") else text
