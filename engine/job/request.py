"""The request for a lift: the content of request.json."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal, get_args

from .. import __version__
from ..errors import PlgsError
from ..json_file import Json, read_object, to_text
from ..presets.options import changed_options, checked_options, option_value, preset_options, with_options
from ..presets.preset import PRESETS, Preset
from ..records import check_record, record_of, refuse_other_format, to_json
from ..scene_source import SceneSource, option

PresetName = Literal["preview", "standard", "paper"]
Bake = Literal["test", "all", "none"]
Device = Literal["cpu", "cuda"]
FURTHER_LAYERS = ("normal", "position")
"""Layers of the passes that are written only if they are chosen. Both follow from the depth, and take as much space as
the colour, or more."""
BAKES: tuple[str, ...] = get_args(Bake)
DEVICES: tuple[str, ...] = get_args(Device)
_NO_BLOCKS = "A long capture fits without blocks: lift anew without them, with fewer --frames if memory is short"
GONE = {"blocks": _NO_BLOCKS, "block": _NO_BLOCKS}
"""Fields of earlier versions' requests, which were options, too, and what to do instead."""
_PLACES = ("scene", "masks", "depth", "names_from")
_FIX = "Fix it, or delete the folder and lift again."


@dataclass(frozen=True)
class LiftRequest(SceneSource):
    """One lift of a scene. Paths are absolute.

    ``options`` are the changed options of the preset, by name (see ``engine/presets``). ``fit`` uses fewer frames if
    memory is limited. ``device`` draws the Gaussians. ``names_from`` is the folder of an earlier lift whose objects
    keep their names and ids.

    Raises PlgsError if a value is out of range. Files are not checked, as this is the scene's task.
    """

    preset: PresetName = "preview"
    options: Mapping[str, Json] = field(default_factory=dict)
    fit: bool = field(
        default=False,
        metadata={"option": {"action": "store_true", "default": None, "help": "use fewer frames if memory is short"}},
    )
    seed: int = field(
        default=0,
        metadata={
            **option("seed of all random numbers: same seed, same result (default: 0)", "N", int),
            "least": 0,
            "most": 2**32 - 1,
        },
    )
    bake: Bake = "test"
    device: Device = field(
        default="cpu",
        metadata={
            "option": {
                "choices": DEVICES,
                "help": "where Gaussians are drawn (default: cpu); cuda needs gsplat, nvcc, ninja and a C++ compiler",
            }
        },
    )
    names_from: Path | None = field(
        default=None,
        metadata=option(
            "an earlier lift of the same scene: objects that are still there keep their names and ids", "LIFT", Path
        ),
    )
    engine_version: str = __version__

    def __post_init__(self) -> None:
        check_record(self, "Give another value.")
        for name in _PLACES:
            path = getattr(self, name)
            if path is not None and not path.is_absolute():
                raise PlgsError(f"the path of '{name}' is not absolute", path, "Give the absolute path.")
            if path is not None:
                refuse_unwritable_name(path)
        changed = changed_options(PRESETS[self.preset], checked_options(self.options))
        object.__setattr__(self, "options", changed)

    @property
    def chosen_preset(self) -> Preset:
        """The preset with the options of the request."""
        return with_options(PRESETS[self.preset], self.options)

    def to_json(self, lift: Path | None = None) -> str:
        """The text of request.json. With the folder of the ``lift`` it also has paths relative to that, so that a lift
        and its scene can be moved together."""
        content = to_json(self)
        options, fit = content.pop("options", {}), content.pop("fit", False)
        content["overrides"] = {**options, **({"fit": True} if fit else {})}
        if lift is not None:
            content["relative"] = _relative(self, lift)
        return to_text({"format": 1, **content})

    @classmethod
    def read(cls, path: Path) -> LiftRequest:
        """The request in a file. Raises PlgsError, which names the file and the key that is wrong."""
        content: dict[str, Any] = read_object(path, _FIX)
        refuse_other_format(content, path)
        for name in sorted(set(GONE) & set(content)):
            raise PlgsError(f"this lift was asked for with --{name}", path, f"{GONE[name]}.")
        overrides, relative = content.pop("overrides", None) or {}, content.pop("relative", {})
        if not isinstance(overrides, dict):
            raise PlgsError("'overrides' is not a JSON object", path, _FIX)
        if not isinstance(relative, dict) or not all(isinstance(value, str) for value in relative.values()):
            raise PlgsError("'relative' is not an object of texts", path, _FIX)
        content |= {"options": _options(overrides, path), "fit": overrides.get("fit", False)}
        for name in _PLACES:
            if isinstance(content.get(name), str) and name in relative:
                content[name] = _place(content[name], relative[name], path)
        try:
            return record_of(cls, content, path, _FIX)
        except PlgsError as error:
            if error.where == str(path):
                raise
            what = f"{error.where}: {error.what}" if error.where else error.what
            raise PlgsError(what, path, error.fix) from error

    def differences(self, other: LiftRequest) -> list[str]:
        """The names of what differs, including the options of the preset, but not the engine's version."""
        mine, theirs = self.chosen_preset, other.chosen_preset
        options = [name for name in preset_options() if option_value(mine, name) != option_value(theirs, name)]
        names = [each.name for each in fields(self) if each.name not in ("options", "engine_version")]
        differing = [name for name in names if getattr(self, name) != getattr(other, name)]
        return [*differing, *([] if "preset" in differing else options)]


def refuse_unwritable_name(path: Path) -> None:
    """Raise PlgsError for a path that is not UTF-8, which no file of a lift can hold and no terminal can show."""
    try:
        str(path).encode()
    except UnicodeEncodeError as error:
        what, fix = "has a name with broken characters (it is not UTF-8)", "Rename it, or the folder it is in."
        raise PlgsError(what, path, fix) from error


def _options(overrides: Mapping[str, Json], path: Path) -> dict[str, Json]:
    """The options among the overrides. Earlier versions wrote most of them as a separate object, and null for steps and
    size that were left to the preset."""
    inner = overrides.get("options", {})
    if not isinstance(inner, dict):
        raise PlgsError("'options' is not a JSON object", path, _FIX)
    unset = [name for name in ("steps", "size") if overrides.get(name) is None]
    return {name: value for name, value in overrides.items() if name not in ("fit", "options", *unset)} | inner


def _relative(request: LiftRequest, lift: Path) -> dict[str, Json]:
    """The paths of a request relative to the lift's folder, without those on another drive."""
    paths = {name: getattr(request, name) for name in _PLACES}
    inside = {name: path for name, path in paths.items() if path is not None and path.drive == lift.drive}
    return {name: Path(os.path.relpath(path, lift)).as_posix() for name, path in inside.items()}


def _place(place: str, relative: str, request: Path) -> str:
    """Where a path of the request leads: to its old place, or else to its present place relative to the lift."""
    moved = os.path.normpath(request.parent.absolute() / relative)
    return moved if not os.path.exists(place) and os.path.exists(moved) else place
