"""What was asked: the content of request.json."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

from .. import __version__
from ..errors import PlgsError
from ..json_file import Json, read_object, to_text
from ..presets.options import changed_options, checked_options, option_value, preset_options, with_options
from ..presets.preset import PRESETS, Preset
from ..scene_source import UPS, SceneSource

FORMAT = 1
PresetName = Literal["preview", "standard", "paper"]
Bake = Literal["test", "all", "none"]
Device = Literal["cpu", "cuda"]
FURTHER_LAYERS = ("normal", "position")
"""Layers of the passes that are written where they are chosen. Both follow from the depth, and take as much as the
colour, or more."""
BAKES: tuple[str, ...] = get_args(Bake)
DEVICES: tuple[str, ...] = get_args(Device)
_KEYS = {
    "format",
    "engine_version",
    "scene",
    "masks",
    "preset",
    "overrides",
    "seed",
    "up",
    "scene_format",
    "depth",
    "mask_format",
    "classes",
    "bake",
    "device",
    "names_from",
    "relative",
    "blocks",
    "block",
}
MOST_BLOCKS = 1000
_BLOCKS = ("blocks", "block")
_PLACES = ("scene", "masks", "depth", "names_from")
_FIX = "Mend it, or delete the folder and lift again."


@dataclass(frozen=True)
class LiftRequest(SceneSource):
    """One lift of a scene. Paths are absolute.

    ``options`` are those of the preset that are changed, by name (see ``engine/presets``). ``fit`` takes fewer frames
    when memory is short. ``device`` draws the Gaussians. ``names_from`` is the folder of an earlier lift whose objects
    keep their names and ids. A building is lifted in so many ``blocks`` (0: it is none); ``block`` is the one of them,
    from 1, that this lift is of (0: it is of all).

    Raises PlgsError when a value is out of range. Files are not looked at: that is the scene's part.
    """

    preset: PresetName = "preview"
    options: Mapping[str, Json] = field(default_factory=dict)
    fit: bool = False
    seed: int = 0
    bake: Bake = "test"
    device: Device = "cpu"
    names_from: Path | None = None
    blocks: int = 0
    block: int = 0
    engine_version: str = field(default=__version__)

    def __post_init__(self) -> None:
        for name in _PLACES:
            path = getattr(self, name)
            if path is not None and not path.is_absolute():
                raise PlgsError(f"the path of '{name}' is not absolute", path, "Give the whole path.")
            if path is not None:
                refuse_unwritable_name(path)
        _one_of("preset", self.preset, tuple(PRESETS))
        _one_of("up", self.up, UPS)
        _one_of("bake", self.bake, BAKES)
        _one_of("device", self.device, DEVICES)
        if not isinstance(self.fit, bool):
            raise PlgsError("is neither true nor false", f"fit = {self.fit!r}", "Leave it out, or write true.")
        changed = changed_options(PRESETS[self.preset], checked_options(self.options))
        object.__setattr__(self, "options", changed)
        if not isinstance(self.seed, int) or isinstance(self.seed, bool) or not 0 <= self.seed < 2**32:
            raise PlgsError("is no seed", f"seed = {self.seed!r}", "Give a whole number from 0 to 4294967295.")
        self._check_blocks()

    def _check_blocks(self) -> None:
        if type(self.blocks) is not int or self.blocks == 1 or not 0 <= self.blocks <= MOST_BLOCKS:
            raise PlgsError("is no number of blocks", f"blocks = {self.blocks!r}", f"Give one from 2 to {MOST_BLOCKS}.")
        if type(self.block) is not int or not 0 <= self.block <= self.blocks:
            fix = f"Give one from 1 to {self.blocks}." if self.blocks else "Say with --blocks how many there are."
            raise PlgsError("is no block of the building", f"block = {self.block!r}", fix)

    @property
    def chosen_preset(self) -> Preset:
        """The preset with the options of the request."""
        return with_options(PRESETS[self.preset], self.options)

    def to_json(self, lift: Path | None = None) -> str:
        """The text of request.json. With the folder of the ``lift`` it also tells paths relative to that, so that a
        lift and its scene can be moved together."""
        given = {
            "scene_format": self.scene_format,
            "depth": None if self.depth is None else str(self.depth),
            "mask_format": self.mask_format,
            "classes": self.classes,
            "device": None if self.device == "cpu" else self.device,
            "names_from": None if self.names_from is None else str(self.names_from),
            "relative": None if lift is None else _relative(self, lift),
            "blocks": self.blocks or None,
            "block": self.block or None,
        }
        return to_text(
            {
                "format": FORMAT,
                "engine_version": self.engine_version,
                "scene": str(self.scene),
                "masks": None if self.masks is None else str(self.masks),
                "preset": self.preset,
                "overrides": {**self.options, **({"fit": True} if self.fit else {})},
                "seed": self.seed,
                "up": self.up,
                "bake": self.bake,
                **{key: value for key, value in given.items() if value is not None},
            }
        )

    @classmethod
    def read(cls, path: Path) -> LiftRequest:
        """The request in a file. Raises PlgsError that names the file and the key that is wrong."""
        content = read_object(path, _FIX)
        _refuse_unknown_format(content, path)
        _refuse_unknown_keys(content, _KEYS, path)
        overrides = content.get("overrides") or {}
        if not isinstance(overrides, dict):
            raise PlgsError("'overrides' is not a JSON object", path, _FIX)
        try:
            return cls(**_arguments(content, overrides, path))
        except PlgsError as error:
            if error.where == str(path):
                raise
            raise PlgsError(f"{error.where}: {error.what}", path, error.fix) from error

    def differences(self, other: LiftRequest) -> list[str]:
        """Names of what differs, the options of the preset among them, the engine's version left out."""
        mine, theirs = self.chosen_preset, other.chosen_preset
        options = [name for name in preset_options() if option_value(mine, name) != option_value(theirs, name)]
        first = ("scene", "masks", "preset", "fit", "seed")
        last = ("up", "scene_format", "depth", "mask_format", "classes", "bake", "device", "names_from", *_BLOCKS)
        differing = [name for name in (*first, *last) if getattr(self, name) != getattr(other, name)]
        return [*differing, *([] if "preset" in differing else options)]


def refuse_unwritable_name(path: Path) -> None:
    """Raise PlgsError for a path that no file of a lift can hold, nor a terminal show: it is not UTF-8."""
    try:
        str(path).encode()
    except UnicodeEncodeError as error:
        what, fix = "has a name with broken characters (it is not UTF-8)", "Rename it, or the folder it is in."
        raise PlgsError(what, path, fix) from error


def _arguments(content: Mapping[str, Json], overrides: Mapping[str, Json], path: Path) -> dict[str, Any]:
    """Keyword arguments of LiftRequest; ranges are checked by itself, types of the texts here."""
    for name in ("scene", "preset", "up", "bake", "engine_version"):
        if not isinstance(content.get(name), str):
            raise PlgsError(f"'{name}' is missing or not a text", path, _FIX)
    device = content.get("device", "cpu")
    if not isinstance(device, str):
        raise PlgsError("'device' is not a text", path, _FIX)
    for name in ("masks", "scene_format", "depth", "mask_format", "classes", "names_from"):
        if not isinstance(content.get(name), str | None):
            raise PlgsError(f"'{name}' is neither a text nor null", path, _FIX)
    return {
        "options": _options(overrides, path),
        **{name: _place(content, name, path) for name in _PLACES},
        **{name: content.get(name) for name in ("scene_format", "mask_format", "classes")},
        "fit": overrides.get("fit", False),
        "seed": content.get("seed"),
        **{name: content.get(name, 0) for name in _BLOCKS},
        "device": device,
        **{name: content[name] for name in ("preset", "up", "bake", "engine_version")},
    }


def _options(overrides: Mapping[str, Json], path: Path) -> dict[str, Json]:
    """The options among the overrides. Earlier versions wrote most of them as an object of their own, and null for
    steps and size that were left to the preset."""
    inner = overrides.get("options", {})
    if not isinstance(inner, dict):
        raise PlgsError("'options' is not a JSON object", path, _FIX)
    unset = [name for name in ("steps", "size") if overrides.get(name) is None]
    return {name: value for name, value in overrides.items() if name not in ("fit", "options", *unset)} | inner


def _refuse_unknown_format(content: Mapping[str, Json], path: Path) -> None:
    if content.get("format") != FORMAT:
        what = f"has format {content.get('format')!r}, this version reads {FORMAT}"
        raise PlgsError(what, path, "Use the version of PLGS that wrote it, or lift into another folder.")


def _refuse_unknown_keys(content: Mapping[str, Json], known: set[str], path: Path) -> None:
    unknown = sorted(set(content) - known)
    if unknown:
        what = f"has {', '.join(map(repr, unknown))}, which this version does not know"
        raise PlgsError(what, path, "Remove it, or use the version of PLGS that wrote it.")


def _relative(request: LiftRequest, lift: Path) -> dict[str, Json]:
    """The paths of a request as seen from the lift's folder, those on another drive left out."""
    paths = {name: getattr(request, name) for name in _PLACES}
    inside = {name: path for name, path in paths.items() if path is not None and path.drive == lift.drive}
    return {name: Path(os.path.relpath(path, lift)).as_posix() for name, path in inside.items()}


def _place(content: Mapping[str, Json], name: str, request: Path) -> Path | None:
    """Where a path of the request leads: where it was, else where it now is, seen from the lift."""
    relative, path = content.get("relative", {}), content.get(name)
    if not isinstance(relative, dict) or not all(isinstance(value, str) for value in relative.values()):
        raise PlgsError("'relative' is not an object of texts", request, _FIX)
    if path is None or os.path.exists(str(path)) or name not in relative:
        return None if path is None else Path(str(path))
    moved = Path(os.path.normpath(request.parent.absolute() / str(relative[name])))
    return moved if os.path.exists(moved) else Path(str(path))


def _one_of(name: str, value: str, known: tuple[str, ...]) -> None:
    if value not in known:
        raise PlgsError(f"is no {name}", f"{name} = {value!r}", f"Choose one of {', '.join(known)}.")
