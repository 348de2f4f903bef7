"""The options of a lift on a command line: the same for the engine and for run_plgs.py."""

from __future__ import annotations

import argparse
import difflib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from ..errors import PlgsError
from ..json_file import Json
from ..presets.options import parsed_options, read_preset_file
from ..presets.preset import PRESETS
from ..scene_source import UP_OPTIONS, SceneSource
from .folder import LiftFolder
from .request import BAKES, GONE, LiftRequest

_NONE: Mapping[str, str] = {}
DEFAULTS = LiftRequest(scene=Path(Path(__file__).anchor))
"""The request with the values of options that are not given; its scene is not a real one."""
_OF_PRESET = ("steps", "size", "frames", "set")
"""The options that change those of the preset."""
_FIELDS = {each.name: each.metadata["option"] for each in fields(LiftRequest) if "option" in each.metadata}


def add_options(parser: argparse.ArgumentParser, *names: str) -> None:
    """Add the options that set these fields of a request, as the fields declare them."""
    for name in names:
        parser.add_argument(_flag(name), dest=name, **_FIELDS[name])


def _flag(name: str) -> str:
    return f"--{name.removeprefix('scene_').replace('_', '-')}"


def add_lift_options(parser: argparse.ArgumentParser, more_bakes: Mapping[str, str] = _NONE) -> None:
    """Add all options that end up in the request, and --poses. Those not given are None, so that --resume can tell.
    ``more_bakes``: other values of --bake, and their meanings; the caller must remove them from the options.
    """
    parser.add_argument(
        "--preset",
        type=preset_or_file,
        metavar="NAME|FILE.toml",
        help=f"how much work to spend: preview takes minutes, standard tens of minutes, paper follows the paper's "
        f"own settings; or your own file, like those that 'presets NAME' prints (default: {DEFAULTS.preset})",
    )
    add_set_option(parser)
    add_amount_options(parser)
    parser.add_argument("--size", type=picture_size, metavar="WxH", help="train at this picture size, such as 320x240")
    add_options(parser, "seed")
    add_scene_options(parser)
    parser.add_argument(
        "--poses", choices=("colmap",),
        help="SCENE is photos or a film: let COLMAP find the poses first, and write them beside the photos",
    )  # fmt: skip
    add_options(parser, "names_from", "device")
    for name, instead in GONE.items():
        parser.add_argument(f"--{name}", type=_gone(instead), help=argparse.SUPPRESS)
    parser.add_argument(
        "--bake",
        choices=(*BAKES, *more_bakes),
        help=f"which frames to render as passes: the held-out ones, all, or none (default: {DEFAULTS.bake})"
        + "".join(f"; {name}: {meaning}" for name, meaning in more_bakes.items()),
    )


def _gone(instead: str) -> Callable[[str], None]:
    """A type for argparse that refuses whatever is given."""

    def refuse(_: str) -> None:
        raise argparse.ArgumentTypeError(instead)

    return refuse


def add_amount_options(parser: argparse.ArgumentParser) -> None:
    """Add --steps, --frames and --fit: how much is trained."""
    parser.add_argument("--steps", type=int, metavar="N", help="training steps instead of the preset's")
    parser.add_argument(
        "--frames", type=number_of_frames, metavar="N|all",
        help="train on at most N frames, the sharpest of each stretch of the recording (default: the preset's)",
    )  # fmt: skip
    add_options(parser, "fit")


def add_progress_option(parser: argparse.ArgumentParser) -> None:
    """--progress."""
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
    """A preset's name, or the path of a preset file, for argparse. Raises ArgumentTypeError."""
    if text in PRESETS or text.endswith(".toml"):
        return text
    near = difflib.get_close_matches(text, PRESETS, 1)
    hint = f"; did you mean {near[0]}?" if near else ""
    raise argparse.ArgumentTypeError(f"{text!r} is neither one of {', '.join(PRESETS)} nor a FILE.toml{hint}")


def add_scene_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that say how to read the scene's folder."""
    add_options(parser, "masks", "mask_format", "classes", "depth", "up", "scene_format")


def source_of(options: argparse.Namespace) -> SceneSource:
    """The source that ``scene`` and the options of `add_scene_options` name."""
    given = {each.name: getattr(options, each.name) for each in fields(SceneSource)}
    return SceneSource(**{name: value for name, value in given.items() if value is not None})


def given_lift_options(options: argparse.Namespace) -> list[str]:
    """The options of `add_lift_options` that were given, as on a command line."""
    names = ("preset", "bake", *_FIELDS, *_OF_PRESET, "poses")
    return [_flag(name) for name in names if getattr(options, name) is not None]


def readable(arguments: Sequence[str]) -> list[str]:
    """The arguments with "--up -y" as "--up=-y", and so for "--range -5-10": argparse reads a value that begins with a
    dash as an option."""
    joined: list[str] = []
    for argument in arguments:
        option = joined[-1] if joined else ""
        if (option == "--up" and argument in UP_OPTIONS) or (option == "--range" and re.match(r"-\d", argument)):
            joined[-1] = f"{option}={argument}"
        else:
            joined.append(argument)
    return joined


def picture_size(text: str) -> tuple[int, int]:
    """(width, height) from "640x480", for argparse. Raises ArgumentTypeError."""
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise argparse.ArgumentTypeError(f"{text!r} is not WIDTHxHEIGHT, such as 640x480")
    return int(width), int(height)


def number_of_frames(text: str) -> int:
    """A number of frames from a number or "all" (0), for argparse. Raises ArgumentTypeError."""
    if text.lower() == "all":
        return 0
    if not re.fullmatch(r"[0-9]{1,7}", text) or not int(text):
        raise argparse.ArgumentTypeError(f"{text!r} is neither a number of frames, such as 300, nor 'all'")
    return int(text)


def request_from(options: argparse.Namespace, base: LiftRequest | None = None) -> LiftRequest:
    """The request that the options of `add_lift_options` and ``scene`` ask for; the rest is as in ``base``.

    Raises PlgsError if a value is out of range.
    """
    asked: dict[str, Any] = {name: getattr(options, name) for name in (*_FIELDS, "bake")}
    given: dict[str, Any] = {
        name: value.resolve() if isinstance(value, Path) else value for name, value in asked.items()
    }
    given = {name: value for name, value in given.items() if value is not None}
    own = {name: getattr(options, name) for name in ("steps", "size", "frames")}
    changed = parsed_options(options.set or ()) | {name: value for name, value in own.items() if value is not None}
    preset, chosen = chosen_options(options.preset, changed, base or DEFAULTS)
    return replace(base or DEFAULTS, scene=options.scene.resolve(), preset=preset, options=chosen, **given)


def chosen_options(
    preset: str | None, changed: Mapping[str, Json], base: LiftRequest = DEFAULTS
) -> tuple[Any, dict[str, Json]]:
    """The name of a preset and its changed options: those of ``preset``, a name or a preset file, or of ``base`` if it
    is None; then the options ``changed``. Raises PlgsError."""
    name, options = (base.preset, dict(base.options)) if preset is None else (preset, {})
    if name.endswith(".toml"):
        name, options = read_preset_file(Path(name))
    if "steps" in changed:  # exactly that many, whatever a file says about many views
        options.pop("steps_a_view", None)
    return name, {**options, **changed}


def resumable(options: argparse.Namespace) -> LiftFolder | None:
    """The lift in ``options.output`` that --resume continues; None if there is nothing to continue.

    Raises PlgsError if the options ask for a lift that differs from the one there.
    """
    folder: Path = options.output
    if not options.resume or not (folder / "request.json").exists():
        return None
    lift = LiftFolder.open(folder)
    differing = request_from(options, base=lift.request).differences(lift.request)
    if differing:
        fix = "Leave these options as they were, or choose another output folder."
        raise PlgsError(f"holds a lift with a different {', '.join(differing)}", lift.path, fix)
    return lift
