"""Which scene the user chose, and how it is read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ..engine.errors import PlgsError
from ..engine.scene import Scene, UpAxis, open_asked
from ..engine.scene_source import SceneSource
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
        """What `of` takes beside the folder."""
        return {
            "masks": "" if self.masks is None else str(self.masks),
            "up": self.up,
            "format": self.scene_format or AUTOMATIC,
            "depth": "" if self.depth is None else str(self.depth),
            "mask_format": self.mask_format or AUTOMATIC,
            "classes": self.classes or "",
        }

    def open(self) -> Scene:
        """Open it, headers only. Raises PlgsError."""
        try:
            return open_asked(self)
        except ImportError as error:
            fix = "Set the engine up, which can, and import again."
            raise PlgsError("Blender's Python alone cannot look into this video", self.scene, fix) from error

    def arguments(self) -> list[str | Path]:
        """The arguments that name it to the engine's commands."""
        arguments: list[str | Path] = [self.scene, f"--up={self.up_option}"]
        given = {"--masks": self.masks, "--format": self.scene_format, "--depth": self.depth}
        named = {"--mask-format": self.mask_format, "--classes": self.classes}
        for option, value in (given | named).items():
            arguments += [] if value is None else [option, value]
        return arguments


def lacks_package(error: PlgsError) -> bool:
    """Whether Blender's Python could not read a scene that an engine's Python may."""
    return isinstance(error.__cause__, ImportError)
