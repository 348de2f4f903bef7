"""Which scene the user chose, and how it is read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ..engine.errors import PlgsError
from ..engine.posed.frames import PosedScene
from ..engine.posed.plain_folders import NAME, open_plain_folders, recognises
from ..engine.scene_source import SceneSource, UpAxis
from .paths import absolute
from .scene_formats import AUTOMATIC, chosen_format


@dataclass(frozen=True)
class ChosenScene(SceneSource):
    """A scene by absolute paths, as the user typed them."""

    @classmethod
    def of(
        cls, folder: str, *, masks: str = "", up: UpAxis = "z", format: str = AUTOMATIC, depth: str = "",
        mask_format: str = AUTOMATIC, classes: str = "",
    ) -> ChosenScene:  # fmt: skip
        """From paths as users type them. Empty texts stand for no masks, no depth maps and no classes."""
        masks_path, depth_path = (absolute(path) if path else None for path in (masks, depth))
        table = str(absolute(classes)) if classes.endswith(".toml") else classes or None
        return cls(
            absolute(folder), masks_path, up, chosen_format(format), depth_path, chosen_format(mask_format), table
        )

    def as_texts(self) -> dict[str, str]:
        """What `of` takes in addition to the folder."""
        return {
            "masks": "" if self.masks is None else str(self.masks),
            "up": self.up,
            "format": self.scene_format or AUTOMATIC,
            "depth": "" if self.depth is None else str(self.depth),
            "mask_format": self.mask_format or AUTOMATIC,
            "classes": self.classes or "",
        }

    @property
    def is_plain(self) -> bool:
        """Whether it is in plain folders, whose cameras and pictures Blender can read alone. Reads the disk."""
        has_lens = (self.scene / "intrinsic").is_dir()  # else a sensor's own file may say it, which the engine reads
        return self.scene_format in (None, NAME) and has_lens and recognises(self.scene)

    def open_plain(self) -> PosedScene:
        """The cameras and pictures of plain folders; of pictures only the headers are read. Raises PlgsError."""
        try:
            return open_plain_folders(self)
        except (OSError, ValueError) as error:  # ValueError: a path that this system cannot even look at
            raise PlgsError(f"cannot be looked at ({error})", self.scene, "Choose other folders.") from error

    def arguments(self) -> list[str | Path]:
        """The arguments that name it to the engine's commands."""
        arguments: list[str | Path] = [self.scene, f"--up={self.up_option}"]
        given = {"--masks": self.masks, "--format": self.scene_format, "--depth": self.depth}
        named = {"--mask-format": self.mask_format, "--classes": self.classes}
        for option, value in (given | named).items():
            arguments += [] if value is None else [option, value]
        return arguments


def needs_engine(chosen: ChosenScene) -> PlgsError:
    """The error for a scene that Blender cannot read alone."""
    what = "Blender alone can read only the folders color, pose and intrinsic, and this is another layout"
    return PlgsError(what, chosen.scene, "Set up the engine, which can read it.")
