"""What was asked: the content of request.json."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

from .. import __version__
from .errors import JobError
from .json_file import Json, read_object, to_text
from .preset_options import checked_options

FORMAT = 1
Preset = Literal["preview", "standard", "paper"]
Up = Literal["z", "y", "-y"]
Bake = Literal["test", "all", "none"]
Device = Literal["cpu", "cuda"]
PRESETS: tuple[str, ...] = get_args(Preset)
UPS: tuple[str, ...] = get_args(Up)
BAKES: tuple[str, ...] = get_args(Bake)
DEVICES: tuple[str, ...] = get_args(Device)
SMALLEST_SIDE, LARGEST_SIDE = 16, 16384
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
}
_OVERRIDES = {"steps", "size", "frames", "fit", "options"}
_OF_THEIR_OWN = {"steps": "steps", "size_within": "size", "most_frames": "frames"}
_FIX = "Mend it, or delete the folder and lift again."


@dataclass(frozen=True)
class LiftRequest:
    """One lift. Paths are absolute; ``size`` is (width, height) in pixels, ``frames`` how many frames are trained on at
    most, 0 = all; None leaves it to the preset. ``fit``: fewer frames where memory would not do otherwise.
    ``scene_format`` names how the scene is laid out; None leaves it to the scene's looks. ``depth`` is a folder of
    depth maps that take the place of the scene's own. ``mask_format`` names how the masks are laid out, ``classes`` the
    table of their classes: a table's name, or the absolute path of a .toml file. ``device``: where the Gaussians are
    drawn. ``names_from`` is the folder of an earlier lift: its objects keep their names and ids. ``options``: other
    choices of the preset, by name (see ``preset_options``).

    Raises JobError when a value is out of range. Files are not looked at: that is the scene's part.
    """

    scene: Path
    masks: Path | None = None
    preset: Preset = "preview"
    steps: int | None = None
    size: tuple[int, int] | None = None
    frames: int | None = None
    fit: bool = False
    seed: int = 0
    up: Up = "z"
    bake: Bake = "test"
    scene_format: str | None = None
    depth: Path | None = None
    mask_format: str | None = None
    classes: str | None = None
    device: Device = "cpu"
    names_from: Path | None = None
    options: Mapping[str, Json] = field(default_factory=dict)
    engine_version: str = field(default=__version__)

    def __post_init__(self) -> None:
        for name in ("scene", "masks", "depth", "names_from"):
            path = getattr(self, name)
            if path is not None and not path.is_absolute():
                raise JobError(f"the path of '{name}' is not absolute", path, "Give the whole path.")
            if path is not None:
                refuse_unwritable_name(path)
        _one_of("preset", self.preset, PRESETS)
        _one_of("up", self.up, UPS)
        _one_of("bake", self.bake, BAKES)
        _one_of("device", self.device, DEVICES)
        if self.steps is not None and not _is_int(self.steps, 1, 10_000_000):
            fix = "Give a whole number from 1 to 10000000."
            raise JobError("is no number of steps", f"steps = {self.steps!r}", fix)
        if self.size is not None and not (
            len(self.size) == 2 and all(_is_int(side, SMALLEST_SIDE, LARGEST_SIDE) for side in self.size)
        ):
            fix = f"Give width and height in pixels, each from {SMALLEST_SIDE} to {LARGEST_SIDE}."
            raise JobError("is no picture size", f"size = {self.size!r}", fix)
        if self.frames is not None and not _is_int(self.frames, 0, 1_000_000):
            fix = "Give a whole number up to 1000000, or all (0 in a request)."
            raise JobError("is no number of frames", f"frames = {self.frames!r}", fix)
        if not isinstance(self.fit, bool):
            raise JobError("is neither true nor false", f"fit = {self.fit!r}", "Leave it out, or write true.")
        for name, other in _OF_THEIR_OWN.items():
            if name in self.options:
                raise JobError(f"the option {name!r} has a place of its own", "options", f"Give it as '{other}'.")
        object.__setattr__(self, "options", checked_options(self.options))
        if not _is_int(self.seed, 0, 2**32 - 1):
            raise JobError("is no seed", f"seed = {self.seed!r}", "Give a whole number from 0 to 4294967295.")

    def to_json(self) -> str:
        """The text of request.json."""
        size = None if self.size is None else list(self.size)
        given = {
            "scene_format": self.scene_format,
            "depth": None if self.depth is None else str(self.depth),
            "mask_format": self.mask_format,
            "classes": self.classes,
            "device": None if self.device == "cpu" else self.device,
            "names_from": None if self.names_from is None else str(self.names_from),
        }
        chosen: dict[str, object] = {} if self.frames is None else {"frames": self.frames}
        if self.fit:
            chosen["fit"] = True
        if self.options:
            chosen["options"] = self.options
        named = {key: value for key, value in given.items() if value is not None}
        return to_text(
            {
                "format": FORMAT,
                "engine_version": self.engine_version,
                "scene": str(self.scene),
                "masks": None if self.masks is None else str(self.masks),
                "preset": self.preset,
                "overrides": {"steps": self.steps, "size": size, **chosen},
                "seed": self.seed,
                "up": self.up,
                "bake": self.bake,
                **named,
            }
        )

    @classmethod
    def read(cls, path: Path) -> LiftRequest:
        """The request in a file. Raises JobError that names the file and the key that is wrong."""
        content = read_object(path, _FIX)
        _refuse_unknown_format(content, path)
        _refuse_unknown_keys(content, _KEYS, path)
        overrides = content.get("overrides") or {}
        if not isinstance(overrides, dict):
            raise JobError("'overrides' is not a JSON object", path, _FIX)
        _refuse_unknown_keys(overrides, _OVERRIDES, path)
        try:
            return cls(**_arguments(content, overrides, path))
        except JobError as error:
            if error.where == str(path):
                raise
            raise JobError(f"{error.where}: {error.what}", path, error.fix) from error

    def differences(self, other: LiftRequest) -> list[str]:
        """Names of what differs, the engine's version left out."""
        reading = ("up", "scene_format", "depth", "mask_format", "classes")
        training = ("preset", "steps", "size", "frames", "fit", "seed", "options")
        names = ("scene", "masks", *training, *reading, "bake", "device", "names_from")
        return [name for name in names if getattr(self, name) != getattr(other, name)]


def refuse_unwritable_name(path: Path) -> None:
    """Raise JobError for a path that no file of a lift can hold, nor a terminal show: it is not UTF-8."""
    try:
        str(path).encode()
    except UnicodeEncodeError as error:
        what, fix = "has a name with broken characters (it is not UTF-8)", "Rename it, or the folder it is in."
        raise JobError(what, path, fix) from error


def _arguments(content: Mapping[str, Json], overrides: Mapping[str, Json], path: Path) -> dict[str, Any]:
    """Keyword arguments of LiftRequest; ranges are checked by itself, types of the texts here."""
    for name in ("scene", "preset", "up", "bake", "engine_version"):
        if not isinstance(content.get(name), str):
            raise JobError(f"'{name}' is missing or not a text", path, _FIX)
    device = content.get("device", "cpu")
    if not isinstance(device, str):
        raise JobError("'device' is not a text", path, _FIX)
    masks, size = content.get("masks"), overrides.get("size")
    for name in ("masks", "scene_format", "depth", "mask_format", "classes", "names_from"):
        if not isinstance(content.get(name), str | None):
            raise JobError(f"'{name}' is neither a text nor null", path, _FIX)
    if not (size is None or isinstance(size, list)):
        raise JobError("'size' is neither [width, height] nor null", path, _FIX)
    options = overrides.get("options") or {}
    if not isinstance(options, dict):
        raise JobError("'options' is not a JSON object", path, _FIX)
    return {
        "options": options,
        "scene": Path(str(content["scene"])),
        "masks": None if masks is None else Path(str(masks)),
        **{name: content.get(name) for name in ("scene_format", "mask_format", "classes")},
        **{name: None if content.get(name) is None else Path(str(content[name])) for name in ("depth", "names_from")},
        "size": None if size is None else tuple(size),
        "steps": overrides.get("steps"),
        "frames": overrides.get("frames"),
        "fit": overrides.get("fit", False),
        "seed": content.get("seed"),
        "device": device,
        **{name: content[name] for name in ("preset", "up", "bake", "engine_version")},
    }


def _refuse_unknown_format(content: Mapping[str, Json], path: Path) -> None:
    if content.get("format") != FORMAT:
        what = f"has format {content.get('format')!r}, this version reads {FORMAT}"
        raise JobError(what, path, "Use the version of PLGS that wrote it, or lift into another folder.")


def _refuse_unknown_keys(content: Mapping[str, Json], known: set[str], path: Path) -> None:
    unknown = sorted(set(content) - known)
    if unknown:
        what = f"has {', '.join(map(repr, unknown))}, which this version does not know"
        raise JobError(what, path, "Remove it, or use the version of PLGS that wrote it.")


def _one_of(name: str, value: str, known: tuple[str, ...]) -> None:
    if value not in known:
        raise JobError(f"is no {name}", f"{name} = {value!r}", f"Choose one of {', '.join(known)}.")


def _is_int(value: object, least: int, most: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and least <= value <= most
