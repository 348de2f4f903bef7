"""The options of a lift on a command line: the same for the engine and for run_plgs.py."""

from __future__ import annotations

import argparse
import difflib
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..errors import PlgsError
from ..json_file import Json
from ..presets.options import parsed_options
from ..presets.preset import PRESETS
from ..presets.toml_file import read_preset_file
from ..scene_source import UP_OPTIONS, SceneSource, class_table
from .folder import LiftFolder
from .request import BAKES, DEVICES, LiftRequest

_NONE: Mapping[str, str] = {}
DEFAULTS = LiftRequest(scene=Path.cwd())
"""The request whose values hold for options that are not given; its scene is none."""
_IN_REQUEST = (
    "preset", "steps", "size", "frames", "fit", "seed", "masks", "mask_format", "classes", "up", "scene_format",
    "depth", "bake", "device", "names_from", "set", "blocks", "block",
)  # fmt: skip


def add_lift_options(parser: argparse.ArgumentParser, more_bakes: Mapping[str, str] = _NONE) -> None:
    """Everything that ends up in the request, and --poses. What is not given is None, so that --resume can tell.
    ``more_bakes``: what else --bake may name, and what that means; the caller has to take it out of the options.
    """
    parser.add_argument(
        "--preset",
        type=preset_or_file,
        metavar="NAME|FILE.toml",
        help=f"how much work to spend: preview takes minutes, standard tens of minutes, paper follows the paper's "
        f"own settings; or a file of your own, as 'presets NAME' prints one (default: {DEFAULTS.preset})",
    )
    add_set_option(parser)
    add_amount_options(parser)
    parser.add_argument("--size", type=picture_size, metavar="WxH", help="train at this picture size, such as 320x240")
    parser.add_argument(
        "--seed", type=int, metavar="N", help=f"start of all chance: same seed, same result (default: {DEFAULTS.seed})"
    )
    add_scene_options(parser)
    parser.add_argument(
        "--poses", choices=("colmap",),
        help="SCENE is photos or a film: let COLMAP find their poses first, beside the photos",
    )  # fmt: skip
    parser.add_argument(
        "--blocks", type=int, metavar="N",
        help="cut a building into N blocks of about as many points, lift one after the other, and join them",
    )  # fmt: skip
    parser.add_argument("--block", type=int, metavar="I", help="lift only this one of the blocks, counted from 1")
    parser.add_argument(
        "--names-from", type=Path, metavar="LIFT",
        help="an earlier lift of the same scene: objects that are still there keep their names and ids",
    )  # fmt: skip
    parser.add_argument(
        "--bake",
        choices=(*BAKES, *more_bakes),
        help=f"which frames to render as passes: the held-out ones, all, or none (default: {DEFAULTS.bake})"
        + "".join(f"; {name}: {meaning}" for name, meaning in more_bakes.items()),
    )
    add_device_option(parser)


def add_amount_options(parser: argparse.ArgumentParser) -> None:
    """--steps, --frames and --fit: how much is trained."""
    parser.add_argument("--steps", type=int, metavar="N", help="training steps instead of the preset's")
    parser.add_argument(
        "--frames", type=number_of_frames, metavar="N|all",
        help="train on at most so many frames, the sharpest of each stretch of the recording (default: the preset's)",
    )  # fmt: skip
    parser.add_argument(
        "--fit", action="store_true", default=None, help="train on fewer frames where memory would not do otherwise"
    )


def add_device_option(parser: argparse.ArgumentParser) -> None:
    """--device."""
    parser.add_argument(
        "--device",
        choices=DEVICES,
        help=f"where Gaussians are drawn (default: {DEFAULTS.device}); cuda needs gsplat, and has not run on a GPU",
    )


def add_progress_option(parser: argparse.ArgumentParser) -> None:
    """--progress."""
    parser.add_argument(
        "--progress", choices=("text", "json"), default="text",
        help="json: the run's events on standard output, one line of JSON each, and all else on standard error",
    )  # fmt: skip


def add_set_option(parser: argparse.ArgumentParser) -> None:
    """--set: any choice of the preset."""
    parser.add_argument(
        "--set", action="append", metavar="NAME=VALUE",
        help="change one of the preset's options ('presets NAME' lists them); may be given again and again",
    )  # fmt: skip


def preset_or_file(text: str) -> str:
    """A preset's name, or the path of a preset file; for argparse, so it raises ArgumentTypeError."""
    if text in PRESETS or text.endswith(".toml"):
        return text
    near = difflib.get_close_matches(text, PRESETS, 1)
    hint = f"; did you mean {near[0]}?" if near else ""
    raise argparse.ArgumentTypeError(f"{text!r} is neither one of {', '.join(PRESETS)} nor a FILE.toml{hint}")


def add_scene_options(parser: argparse.ArgumentParser) -> None:
    """How to read the scene's folder."""
    parser.add_argument("--masks", type=Path, metavar="PATH", help="panoptic masks, where not in SCENE itself")
    add_label_options(parser)
    parser.add_argument(
        "--depth", type=Path, metavar="FOLDER", help="depth maps of a network, fitted to the scene's sparse points"
    )
    add_capture_options(parser)


def add_label_options(parser: argparse.ArgumentParser) -> None:
    """How to read masks."""
    parser.add_argument(
        "--mask-format",
        metavar="NAME",
        help="how the masks are laid out, such as coco, transformers, sam2, pairs (default: recognised by their looks)",
    )
    parser.add_argument(
        "--classes",
        type=class_table,
        metavar="FILE.toml",
        help="the masks' classes, or one of coco, ade20k, cityscapes, nyu40, scannet200, replica, reduced (default: "
        "classes.toml beside them)",
    )


def add_capture_options(parser: argparse.ArgumentParser) -> None:
    """How to read the pictures and poses in the scene's folder."""
    parser.add_argument(
        "--up",
        type=up_axis,
        metavar="|".join(UP_OPTIONS),
        help="the axis of the poses that points up (default: auto, what the format says, else z)",
    )
    add_format_option(parser)


def add_format_option(parser: argparse.ArgumentParser) -> None:
    """How a scene is laid out."""
    parser.add_argument(
        "--format",
        dest="scene_format",
        metavar="NAME",
        help="how SCENE is laid out, such as colmap, nerfstudio, polycam, tum (default: recognised by its looks)",
    )


def source_of(options: argparse.Namespace) -> SceneSource:
    """What ``scene`` and the options of `add_scene_options` name."""
    up = options.up or DEFAULTS.up
    named = options.mask_format, options.classes
    return SceneSource(options.scene, options.masks, up, options.scene_format, options.depth, *named)


def given_lift_options(options: argparse.Namespace) -> list[str]:
    """Those of `add_lift_options` that were given, as a command line has them."""
    given = [name for name in (*_IN_REQUEST, "poses") if getattr(options, name) is not None]
    return [f"--{name.removeprefix('scene_').replace('_', '-')}" for name in given]


def readable(arguments: Sequence[str]) -> list[str]:
    """The arguments with "--up -y" as "--up=-y": argparse takes a value that begins with a dash for an option. So too
    with "--range -5-10", for what is wrong with that to be told."""
    joined: list[str] = []
    for argument in arguments:
        option = joined[-1] if joined else ""
        if (option == "--up" and argument in UP_OPTIONS) or (option == "--range" and re.match(r"-\d", argument)):
            joined[-1] = f"{option}={argument}"
        else:
            joined.append(argument)
    return joined


def up_axis(text: str) -> str:
    """What --up means; for argparse, so it raises ArgumentTypeError."""
    if text not in UP_OPTIONS:
        raise argparse.ArgumentTypeError(f"{text!r} is none of {', '.join(UP_OPTIONS)}")
    return UP_OPTIONS[text]


def picture_size(text: str) -> tuple[int, int]:
    """(width, height) from "640x480"; for argparse, so it raises ArgumentTypeError."""
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise argparse.ArgumentTypeError(f"{text!r} is not WIDTHxHEIGHT, such as 640x480")
    return int(width), int(height)


def number_of_frames(text: str) -> int:
    """From a number or "all", which is 0; for argparse, so it raises ArgumentTypeError."""
    if text.lower() == "all":
        return 0
    if not re.fullmatch(r"[0-9]{1,7}", text) or not int(text):
        raise argparse.ArgumentTypeError(f"{text!r} is no number of frames, such as 300, and not 'all'")
    return int(text)


def request_from(options: argparse.Namespace, base: LiftRequest | None = None) -> LiftRequest:
    """The request that the options of `add_lift_options` and ``scene`` ask for; the rest as in ``base``.

    Raises PlgsError when a value is out of range.
    """
    names = ("fit", "seed", "up", "scene_format", "mask_format", "classes", "bake", "device", "blocks", "block")
    given = {name: getattr(options, name) for name in names if getattr(options, name) is not None}
    for name in ("masks", "depth", "names_from"):
        if getattr(options, name) is not None:
            given[name] = getattr(options, name).resolve()
    own = {name: getattr(options, name) for name in ("steps", "size", "frames")}
    changed = parsed_options(options.set or ()) | {name: value for name, value in own.items() if value is not None}
    preset, chosen = chosen_options(options.preset, changed, base or DEFAULTS)
    return replace(base or DEFAULTS, scene=options.scene.resolve(), preset=preset, options=chosen, **given)


def chosen_options(
    preset: str | None, changed: Mapping[str, Json], base: LiftRequest = DEFAULTS
) -> tuple[Any, dict[str, Json]]:
    """The name of a preset and its changed options: those of ``preset``, a name or a preset file, or of ``base`` where
    it is None; then the options ``changed``. Raises PlgsError."""
    name, options = (base.preset, dict(base.options)) if preset is None else (preset, {})
    if name.endswith(".toml"):
        name, options = read_preset_file(Path(name))
    if "steps" in changed:  # exactly that many, whatever a file says of many views
        options.pop("steps_a_view", None)
    return name, {**options, **changed}


def resumable(options: argparse.Namespace) -> LiftFolder | None:
    """The lift in ``options.output`` that --resume goes on with; None when there is nothing to go on with.

    Raises PlgsError when the options ask for another lift than the one there.
    """
    folder: Path = options.output
    if not options.resume or not (folder / "request.json").exists():
        return None
    lift = LiftFolder.open(folder)
    differing = request_from(options, base=lift.request).differences(lift.request)
    if differing:
        fix = "Leave these options as they were, or choose another output folder."
        raise PlgsError(f"holds a lift with another {', '.join(differing)}", lift.path, fix)
    return lift
