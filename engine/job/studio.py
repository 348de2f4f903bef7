"""A studio's defaults: one TOML file that the command line, batches and Blender read. Standard library only."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path

from ..presets.options import read_toml
from ..presets.preset import PRESETS
from ..records import record_of
from .cameras import filled_name
from .request import Device

VARIABLE = "PLGS_DEFAULTS"
"""The variable that names the file. Blender's preferences can name it, too."""
_FIX = "Correct it, or let PLGS_DEFAULTS and the preferences name another file."


@dataclass(frozen=True)
class StudioDefaults:
    """Defaults from a studio's ``file``. ``preset`` is a name or a preset file; ``masks`` a path, with {scene} for the
    scene's name; ``names`` a template of file names (--shot); ``memory`` the GB that a lift, or a worker of a batch,
    may use."""

    preset: str | None = None
    masks: str | None = None
    names: str | None = None
    device: Device | None = None
    memory: float | None = field(default=None, metadata={"least": 0.1, "most": 1e6})
    file: Path | None = field(default=None, metadata={"apart": True})

    def __post_init__(self) -> None:
        if self.names is not None and {*"{}"} & {*self.names}:
            try:
                filled_name(self.names, "shot", "camera", 1)
            except ValueError as error:
                raise ValueError(f"'names' cannot be filled in ({error})") from error
        if self.masks is not None and {*"{}"} & {*self.masks.replace("{scene}", "")}:
            raise ValueError(f"'masks' may have the field {{scene}} only, but is {self.masks!r}")
        if self.preset is None or self.preset in PRESETS:
            return
        if not self.preset.endswith(".toml"):
            raise ValueError(f"'preset' is neither one of {', '.join(PRESETS)} nor a FILE.toml")
        assert self.file is not None
        object.__setattr__(self, "preset", str(self.file.parent / self.preset))

    def __str__(self) -> str:
        given = {each.name: getattr(self, each.name) for each in fields(self) if each.name != "file"}
        return ", ".join(f"{name} {value}" for name, value in given.items() if value is not None)

    def masks_of(self, scene: Path | None) -> Path | None:
        """Return the masks' path for a scene; None without a default. If ``scene`` is None, {scene} stays in it."""
        if self.masks is None or self.file is None:
            return None
        name = "{scene}" if scene is None else scene.name if scene.is_dir() else scene.stem
        return self.file.parent / self.masks.replace("{scene}", name)


def studio_defaults(environ: Mapping[str, str] = os.environ) -> StudioDefaults:
    """Read the defaults from the file that an environment variable names; without it, all are None. Raises PlgsError
    for a bad file."""
    if not (named := environ.get(VARIABLE)):
        return StudioDefaults()
    file = Path(named).absolute()
    return record_of(StudioDefaults, read_toml(file, _FIX), file, _FIX, file=file)


def filled_in(options: argparse.Namespace) -> argparse.Namespace:
    """Return a command's options. Those that were not given have the studio's defaults, which are also printed to
    standard error. Raises PlgsError for a bad file of defaults."""
    studio, given = studio_defaults(), vars(options)
    masks = studio.masks_of(given.get("scene"))
    defaults = {"preset": studio.preset, "masks": masks, "device": studio.device, "memory": studio.memory}
    taken = {name: value for name, value in defaults.items() if value and name in given and not given[name]}
    if taken:
        print(f"{studio.file} sets {', '.join(f'{name} {value}' for name, value in taken.items())}", file=sys.stderr)
    return argparse.Namespace(**given | taken)
