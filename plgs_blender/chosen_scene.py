"""The scene that the user chose, how to read it, and the scene or lift to which a file belongs."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import bpy

from ..engine.errors import PlgsError
from ..engine.posed.frames import PosedScene
from ..engine.posed.plain_folders import NAME, open_plain_folders, recognises
from ..engine.scene_source import MASK_FORMAT_NAMES, SCENE_FORMAT_NAMES, SceneSource, UpAxis


def absolute(path: str) -> Path:
    """Return the path made absolute, without a trailing slash; "//" stands for the .blend's folder."""
    full = bpy.path.abspath(path)
    return Path(os.path.abspath(full) if path.startswith("//") else full).absolute()  # "//../room" as Blender reads it


def free_folder(beside: Path, ending: str) -> Path:
    """Return a folder that does not exist yet: "room_lift", "room_lift_2" for ``beside`` "room", ``ending`` "_lift"."""
    number, folder = 1, beside.with_name(f"{beside.name}_{ending}")
    while folder.exists():
        number += 1
        folder = beside.with_name(f"{beside.name}_{ending}_{number}")
    return folder


AUTOMATIC = "auto"
"""The choice that detects the format from the scene's files."""

FORMAT_ITEMS = [(AUTOMATIC, "Automatic", "Detected from the names of the files"), *map(tuple, SCENE_FORMAT_NAMES)]
MASK_FORMAT_ITEMS = [FORMAT_ITEMS[0], *map(tuple, MASK_FORMAT_NAMES)]
"""Items of EnumProperties."""

FILE_SUFFIXES = (".json", ".txt", ".jsonl", ".sens", ".r3d", ".log", ".bin", ".csv")
"""Suffixes of files by which users name a scene, in a file browser or by dropping them."""


def label_of(name: str) -> str:
    """Return a format's label for users, given its name in options."""
    return next((each.label for each in SCENE_FORMAT_NAMES if each.name == name), name)


def chosen_format(choice: str) -> str | None:
    """Return the format's name for a choice of FORMAT_ITEMS or MASK_FORMAT_ITEMS; None means that it is detected."""
    return None if choice in ("", AUTOMATIC) else choice


@dataclass(frozen=True)
class ChosenScene(SceneSource):
    """A scene and how to read it, with absolute paths."""

    @classmethod
    def of(
        cls, folder: str, *, masks: str = "", up: UpAxis = "z", format: str = AUTOMATIC, depth: str = "",
        mask_format: str = AUTOMATIC, classes: str = "", detections: str = "",
    ) -> ChosenScene:  # fmt: skip
        """Return the scene for paths as users type them; "" means no masks, no depth maps and no classes."""
        paths = (absolute(path) if path else None for path in (masks, depth, detections))
        masks_path, depth_path, detections_path = paths
        table = str(absolute(classes)) if classes.endswith(".toml") else classes or None
        return cls(
            absolute(folder), masks_path, up, chosen_format(format), depth_path, chosen_format(mask_format), table,
            detections_path,
        )  # fmt: skip

    @property
    def is_plain(self) -> bool:
        """Whether the scene has plain folders, which Blender can read without an engine. Reads the disk."""
        has_lens = (self.scene / "intrinsic").is_dir()  # else it may be in a sensor's file, which the engine reads
        return self.scene_format in (None, NAME) and has_lens and recognises(self.scene)

    def open_plain(self) -> PosedScene:
        """Open plain folders, reading only the headers of pictures. Raises PlgsError if they are incomplete."""
        try:
            return open_plain_folders(self)
        except (OSError, ValueError) as error:  # ValueError: not a possible path on this system
            what = f"cannot be read as a scene ({error})"
            raise PlgsError("bad-path", what, self.scene, "Choose another folder.") from error

    def arguments(self) -> list[str | Path]:
        """Return this scene as arguments of the engine's commands."""
        arguments: list[str | Path] = [self.scene, f"--up={self.up_option}"]
        given = {"--masks": self.masks, "--format": self.scene_format, "--depth": self.depth}
        named = {"--mask-format": self.mask_format, "--classes": self.classes, "--detections": self.detections}
        for option, value in (given | named).items():
            arguments += [] if value is None else [option, value]
        return arguments


def as_texts(source: SceneSource) -> dict[str, str]:
    """Return a source as the arguments of `ChosenScene.of`, except the folder, as text; unknown formats: AUTOMATIC."""
    paths = {"masks": source.masks, "depth": source.depth, "detections": source.detections}
    texts = {name: "" if path is None else str(path) for name, path in paths.items()}
    formats = ("format", source.scene_format, FORMAT_ITEMS), ("mask_format", source.mask_format, MASK_FORMAT_ITEMS)
    for name, choice, items in formats:
        texts[name] = choice if choice in [item[0] for item in items] else AUTOMATIC
    return texts | {"up": source.up, "classes": source.classes or ""}


def needs_engine(chosen: ChosenScene) -> PlgsError:
    """Return the error for a scene that Blender cannot read without an engine."""
    what = "Blender alone reads only the folders color, pose and intrinsic, and this is another layout"
    return PlgsError("needs-engine", what, chosen.scene, "Set up the engine, which can read it.")


_SCENE_FILES = (".sens", ".r3d")  # suffixes of files that are whole scenes
_PARTS = {
    "color", "depth", "pose", "intrinsic", "rgb", "image", "images", "input", "results", "panoptic", "semantic",
    "instance", "masks", "keyframes", "cameras", "corrected_cameras", "corrected_images", "corrected_depth",
    "confidence", "iphone", "rgbd", "sparse", "0", "model", "colmap", "_detail", "m2f_semantics", "m2f_instance",
}  # fmt: skip
"""Names of folders inside a scene, which help to find the scene's folder."""
_HIGHEST = 3  # search at most this many folders up, as from result/passes/0001.exr to its lift


def lift_or_scene(path: Path) -> tuple[Path | None, Path | None]:
    """Return the lift's folder and None, or None and the scene's folder or file, to which a path belongs."""
    path = path.absolute()
    for folder in [path, *path.parents][: _HIGHEST + 1]:
        if (folder / "request.json").is_file():
            return folder, None
    return None, scene_at(path)


def scene_at(path: Path) -> Path:
    """Return the scene's folder or file to which a path belongs. Raises PlgsError if the path does not exist."""
    path = path.absolute()
    if not path.exists():
        raise PlgsError("file-missing", "there is no such file", path, "Choose the scene's folder, or a file in it.")
    if path.is_file() and path.suffix.lower() in _SCENE_FILES:
        return path
    folder = path if path.is_dir() else path.parent
    for _ in range(_HIGHEST):
        if folder.name.lower() not in _PARTS and not folder.name.startswith("scene_cam_"):
            break
        folder = folder.parent
    return folder
