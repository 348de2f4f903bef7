"""The request for a lift: the content of request.json, and the command-line options that make one."""

from __future__ import annotations

import argparse
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal, NoReturn, get_args

from .. import __version__
from ..errors import PlgsError, did_you_mean, ended, one_line
from ..json_file import Json, read_object, to_text
from ..presets import options as presets
from ..presets.preset import PRESETS, Preset
from ..records import check_record, record_of, refuse_other_format, to_json
from ..scene_source import UP_OPTIONS, SceneSource, option

PresetName = Literal["draft", "preview", "standard", "paper"]
Bake = Literal["test", "all", "none"]
Device = Literal["cpu", "cuda", "auto"]
FURTHER_LAYERS = ("normal", "position", "vector")
"""Layers of the passes that are written only if they are chosen. All follow from the depth, and take as much space as
the colour, or more."""
CHANNELS = ("blender", "nuke")
"""Programs whose naming of channels passes can follow."""
BAKES: tuple[str, ...] = get_args(Bake)
DEVICES: tuple[str, ...] = get_args(Device)
_ABOUT_DEVICES = (
    "where to train and draw (default: cpu); cuda is experimental, never run by us on a GPU, and needs gsplat, nvcc, "
    "ninja and a C++ compiler; auto is cpu, and says why"
)
_ABOUT_SEEDS = "seed of all random numbers: same seed, same result (default: 0)"
_PLACES = ("scene", "masks", "detections", "depth", "names_from")
_FIX = "Correct the file, or delete the folder and lift again."


def _switch(about: str) -> dict[str, Any]:
    return {"option": {"action": "store_true", "default": None, "help": about}}


@dataclass(frozen=True)
class LiftRequest(SceneSource):
    """The request for one lift of a scene. Relative paths are taken from the working directory, and become absolute.
    ``options`` are the changed options of the preset, by name (see ``engine/presets``). ``fit`` uses fewer frames if
    memory is limited; ``seed`` starts random numbers. If ``bake`` is None, what is usual for the preset is baked
    (``bakes``). ``device`` trains and renders the Gaussians. ``names_from`` is the folder of an earlier lift whose
    objects keep their names and ids. ``anyway`` lifts even if the scene's numbers or masks are certainly wrong. Raises
    PlgsError if a value is out of range. Files are checked later, when the scene is opened."""

    preset: PresetName = "preview"
    options: Mapping[str, Json] = field(default_factory=dict)
    fit: bool = field(default=False, metadata=_switch("use fewer frames if memory is short"))
    seed: int = field(default=0, metadata=option(_ABOUT_SEEDS, "N", int) | {"least": 0, "most": 2**32 - 1})
    bake: Bake | None = None
    device: Device = field(default="cpu", metadata={"option": {"choices": DEVICES, "help": _ABOUT_DEVICES}})
    names_from: Path | None = field(
        default=None,
        metadata=option(
            "an earlier lift of the same scene: objects that are still there keep their names and ids", "LIFT", Path
        ),
    )
    anyway: bool = field(default=False, metadata=_switch("lift even a scene that is clearly wrong"))
    engine_version: str = __version__

    def __post_init__(self) -> None:
        check_record(self, "Give another value.")
        for name in _PLACES:
            path = getattr(self, name)
            if path is not None:
                refuse_unwritable_name(path)
                object.__setattr__(self, name, path.absolute())
        changed = presets.changed_options(PRESETS[self.preset], presets.checked_options(self.options))
        object.__setattr__(self, "options", changed)

    @property
    def chosen_preset(self) -> Preset:
        """The preset, changed by the request's options."""
        return presets.with_options(PRESETS[self.preset], self.options)

    @property
    def bakes(self) -> Bake:
        return self.bake or usual_bake(self.preset)

    def to_json(self, lift: Path | None = None) -> str:
        """Return the text of request.json. Paths are relative to ``lift``, if given, so that both can be moved."""
        content = to_json(self)
        options, fit = content.pop("options", {}), content.pop("fit", False)
        content["overrides"] = {**options, **({"fit": True} if fit else {})}
        if lift is not None:
            places = {name: path for name in _PLACES if (path := getattr(self, name)) is not None}
            content["relative"] = {
                name: Path(os.path.relpath(path, lift)).as_posix()
                for name, path in places.items()
                if path.drive == lift.drive  # on Windows no relative path leads to another drive
            }
        return to_text({"format": 1, **content})

    @classmethod
    def read(cls, path: Path) -> LiftRequest:
        """The request in a file. Raises PlgsError, which names the file and the key that is wrong."""
        content: dict[str, Any] = read_object(path, _FIX)
        refuse_other_format(content, path)
        overrides, relative = content.pop("overrides", None) or {}, content.pop("relative", {})
        if not isinstance(overrides, dict):
            raise PlgsError("bad-overrides", "'overrides' is not a JSON object", path, _FIX)
        if not isinstance(relative, dict) or not all(isinstance(value, str) for value in relative.values()):
            raise PlgsError("bad-relative", "'relative' is not a JSON object of strings", path, _FIX)
        content |= {"fit": overrides.pop("fit", False), "options": overrides}
        for name in _PLACES:
            given = content.get(name)
            if isinstance(given, str) and not Path(given).is_absolute():
                raise PlgsError("relative", f"the path of '{name}' is not absolute", path, "Give the absolute path.")
            if isinstance(given, str) and name in relative:
                moved = os.path.normpath(path.parent.absolute() / relative[name])
                content[name] = moved if not os.path.exists(given) and os.path.exists(moved) else given
        try:
            return record_of(cls, content, path, _FIX)
        except PlgsError as error:
            if error.where == str(path):
                raise
            raise PlgsError(error.key, error.problem, path, error.fix) from error

    def differences(self, other: LiftRequest) -> list[str]:
        """The names of all fields and preset options that differ, except ``anyway`` and the engine's version."""
        mine, theirs = self.chosen_preset, other.chosen_preset
        value = presets.option_value
        options = [name for name in presets.preset_options() if value(mine, name) != value(theirs, name)]
        names = [each.name for each in fields(self) if each.name not in ("options", "anyway", "engine_version")]
        pairs = zip(*(vars(replace(one, bake=one.bakes)).items() for one in (self, other)), strict=True)
        differing = [name for (name, one), (_, its) in pairs if name in names and one != its]
        return [*differing, *([] if "preset" in differing else options)]


def refuse_unwritable_name(path: Path) -> None:
    """Raise PlgsError for a path that is not UTF-8, as no file of a lift can hold it and no terminal show it."""
    try:
        str(path).encode()
    except UnicodeEncodeError as error:
        what, fix = "has a name with broken characters (it is not UTF-8)", "Rename it, or the folder it is in."
        raise PlgsError("name-not-utf8", what, path, fix) from error


_NONE: Mapping[str, str] = {}
DEFAULTS = LiftRequest(scene=Path(Path(__file__).anchor))
"""The request with all options at their defaults; its scene is a placeholder."""
_OF_PRESET = ("steps", "size", "frames", "set")  # the options that change those of the preset
_FIELDS = {each.name: each.metadata["option"] for each in fields(LiftRequest) if "option" in each.metadata}


def usual_bake(preset: str) -> Bake:
    """Return which frames a lift by this preset bakes if ``bake`` is not given."""
    return "none" if preset == "draft" else "test"


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line, without the usage. Its subparsers are of this class, too."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, one_line(f"error: {ended(message)} '{self.prog} --help' lists all options.") + "\n")


def add_options(parser: argparse.ArgumentParser, *names: str) -> None:
    """Add the options that set these fields of a request, as the fields declare them."""
    for name in names:
        parser.add_argument(_flag(name), dest=name, **_FIELDS[name])


def _flag(name: str) -> str:
    return f"--{name.removeprefix('scene_').replace('_', '-')}"


def add_lift_options(parser: argparse.ArgumentParser, more_bakes: Mapping[str, str] = _NONE) -> None:
    """Add all options that end up in the request, and --poses. Those not given are None, so that --resume can tell.
    ``more_bakes`` are further values of --bake and their meanings, which the caller must handle and remove."""
    parser.add_argument(
        "--preset", type=preset_or_file, metavar="NAME|FILE.toml",
        help="how much work to spend: draft takes half of preview's time, preview takes minutes, standard tens of "
        "minutes, paper follows the paper's own settings; or your own file, like those that 'presets NAME' prints "
        f"(default: {DEFAULTS.preset})",
    )  # fmt: skip
    add_set_option(parser)
    add_amount_options(parser)
    parser.add_argument("--size", type=picture_size, metavar="WxH", help="train at this picture size, such as 320x240")
    add_options(parser, "seed")
    add_scene_options(parser)
    parser.add_argument(
        "--poses", choices=("colmap",),
        help="SCENE is photos or a film: let COLMAP find the poses first, and write them beside the photos",
    )  # fmt: skip
    add_options(parser, "names_from", "device", "anyway")
    parser.add_argument(
        "--bake", choices=(*BAKES, *more_bakes),
        help="which frames to render as passes: the held-out ones, all, or none (default: test, for a draft none)"
        + "".join(f"; {name}: {meaning}" for name, meaning in more_bakes.items()),
    )  # fmt: skip


def add_amount_options(parser: argparse.ArgumentParser) -> None:
    """Add --steps, --frames and --fit: how much is trained."""
    parser.add_argument("--steps", type=int, metavar="N", help="training steps instead of the preset's")
    parser.add_argument(
        "--frames", type=number_of_frames, metavar="N|all",
        help="train on at most N frames, the sharpest of each stretch of the recording (default: the preset's)",
    )  # fmt: skip
    add_options(parser, "fit")


def add_progress_option(parser: argparse.ArgumentParser) -> None:
    """Add --progress, which chooses between text and JSON."""
    parser.add_argument(
        "--progress", choices=("text", "json"), default="text",
        help="json: write the run's events to standard output, one JSON line each, and all else to standard error",
    )  # fmt: skip


def add_set_option(parser: argparse.ArgumentParser) -> None:
    """Add --set, which changes any option of the preset."""
    parser.add_argument(
        "--set", action="append", metavar="NAME=VALUE",
        help="change one of the preset's options ('presets NAME' lists them); may be given more than once",
    )  # fmt: skip


def preset_or_file(text: str) -> str:
    """Return the name of a preset, or of a preset file, unchanged, for argparse. Raises ArgumentTypeError."""
    if text in PRESETS or text.endswith(".toml"):
        return text
    what = f"{text!r} is neither one of {', '.join(PRESETS)} nor a FILE.toml"
    raise argparse.ArgumentTypeError(f"{what}. {did_you_mean(text, PRESETS)}".rstrip())


def add_scene_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that say how to read the scene's folder."""
    add_options(parser, "masks", "mask_format", "detections", "classes", "depth", "up", "scene_format")


def source_of(options: argparse.Namespace) -> SceneSource:
    """Return where a scene is and how to read it, from a command's ``scene`` and options of `add_scene_options`."""
    given = {each.name: getattr(options, each.name) for each in fields(SceneSource)}
    return SceneSource(**{name: value for name, value in given.items() if value is not None})


def given_lift_options(options: argparse.Namespace) -> list[str]:
    """Return those options of `add_lift_options` that were given, spelt as on a command line."""
    names = ("preset", "bake", *_FIELDS, *_OF_PRESET, "poses")
    return [_flag(name) for name in names if getattr(options, name) is not None]


def readable(arguments: Sequence[str]) -> list[str]:
    """Return the arguments with "--up -y" as "--up=-y", as argparse takes a value with a dash for an option."""
    joined: list[str] = []
    for argument in arguments:
        option = joined[-1] if joined else ""
        if (option == "--up" and argument in UP_OPTIONS) or (option == "--range" and re.match(r"-\d", argument)):
            joined[-1] = f"{option}={argument}"
        else:
            joined.append(argument)
    return joined


def picture_size(text: str) -> tuple[int, int]:
    """Parse a text such as "640x480" as (width, height), for argparse. Raises ArgumentTypeError."""
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise argparse.ArgumentTypeError(f"{text!r} is not WIDTHxHEIGHT, such as 640x480")
    return int(width), int(height)


def number_of_frames(text: str) -> int:
    """Parse a number of frames, or "all", which is 0, for argparse. Raises ArgumentTypeError."""
    if text.lower() == "all":
        return 0
    if not re.fullmatch(r"[0-9]{1,7}", text) or not int(text):
        raise argparse.ArgumentTypeError(f"{text!r} is neither a number of frames, such as 300, nor 'all'")
    return int(text)


def request_from(options: argparse.Namespace, base: LiftRequest | None = None) -> LiftRequest:
    """Return the request that ``scene`` and the options of `add_lift_options` ask for; what is not given comes from
    ``base``. Raises PlgsError for bad values."""
    asked = {name: value for name in (*_FIELDS, "bake") if (value := getattr(options, name)) is not None}
    given: dict[str, Any] = {name: each.resolve() if isinstance(each, Path) else each for name, each in asked.items()}
    own = {name: value for name in ("steps", "size", "frames") if (value := getattr(options, name)) is not None}
    changed = presets.parsed_options(options.set or ()) | own
    preset, chosen = chosen_options(options.preset, changed, base or DEFAULTS)
    return replace(base or DEFAULTS, scene=options.scene.resolve(), preset=preset, options=chosen, **given)


def chosen_options(
    preset: str | None, changed: Mapping[str, Json], base: LiftRequest = DEFAULTS
) -> tuple[Any, dict[str, Json]]:
    """Return the name of a preset and its changed options: first those of ``preset`` (a name or a preset file), or of
    ``base`` if it is None, then those in ``changed``. Raises PlgsError for a bad preset file."""
    name, options = (base.preset, dict(base.options)) if preset is None else (preset, {})
    if name.endswith(".toml"):
        name, options = presets.read_preset_file(Path(name))
    if "steps" in changed:  # exactly that many, whatever a file says about many views
        options.pop("steps_a_view", None)
    return name, {**options, **changed}
