"""The commands of ``python -m engine``: the parser of their options, and running one to its exit code."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from .. import __version__
from ..errors import PlgsError, did_you_mean
from ..gates import printable
from ..job import CHANNELS, FURTHER_LAYERS, EventWriter, ExitCode, StopSignal, request
from ..job.handshake import ADDED, ALSO_ADDED, CAPABILITIES
from ..job.system import refuse_small_memory
from ..job.task import TaskFiles
from ..job.terminal import Interrupted, Interrupts, stdout_for_events
from ..known_networks import DEPTH, MASKS, listing
from ..presets.preset import PRESETS
from . import commands
from .batch import add_batch, add_worker
from .correct import add_correct
from .runner import Command, drop_output, failure_of, run_task

FRAME_FILES = ("colour", "depth", "masks", "cloud")
SEGMENT_MODEL = MASKS[0].name
Run = Callable[[argparse.Namespace, EventWriter, StopSignal], object]
EXPORTS = (
    "coco", "instances", "scannet", "points", "splats", "boxes", "mesh", "surface", "gltf", "usd", "depth", "clouds",
)  # fmt: skip


class Parser(request.Parser):
    """A parser whose commands refuse unknown options themselves, as they know their own and their own --help."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> tuple[Any, list[str]]:
        found, unknown = super().parse_known_args(args, namespace)
        if unknown:
            near = did_you_mean(unknown[0].partition("=")[0], self._option_string_actions)
            self.error(f"unrecognized arguments: {' '.join(unknown)}. {near}".rstrip())
        return found, unknown


def make_parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog="python -m engine", description="Panoptic lifting with structured 3D Gaussians, without Blender."
    )
    parser.add_argument("--version", action="version", version=__version__)
    known = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _add_lift(known.add_parser("lift", help="lift posed RGB-D frames and their masks"))
    _add_bake(known.add_parser("bake", help="render more frames of a finished lift, or any cameras, as passes"))
    add_batch(known.add_parser("batch", help="lift, bake and score many scenes, on one machine or many"), EXPORTS)
    add_worker(known.add_parser("worker", help="work for the scheduler of batches on this machine"))
    add_correct(known.add_parser("correct", help="correct the labels of a finished lift, without training"), _make_task)
    _add_export(known.add_parser("export", help="write a finished lift in a format that other programs read"))
    _add_evaluate(known.add_parser("evaluate", help="show how good a finished lift is"))
    _add_inspect(known.add_parser("inspect", help="read a scene and show what is in it and what is wrong with it"))
    _add_classes(known.add_parser("classes", help="list the classes of a scene's masks, or write an edited list"))
    _add_find_scene(known.add_parser("find-scene", help="update a lift after its scene was moved"))
    _add_frames(known.add_parser("frames", help="write a scene's pictures, depth and masks as plain image files"))
    _add_poses(known.add_parser("poses", help="find the poses of photos or of a film's pictures, with COLMAP"))
    _add_segment(known.add_parser("segment", help="make masks for a scene that has none"))
    _add_prepare(known.add_parser("prepare", help="make what a lift of a film or of photos needs: poses, depth, masks"))
    _add_depth(known.add_parser("depth", help="make depth for a scene that has none, with a network"))
    _add_scale(known.add_parser("scale", help="set the scale of a scene whose lengths have no unit"))
    _add_presets(known.add_parser("presets", help="show the presets and all their options"))
    handshake = known.add_parser("handshake", help="show at once what this engine is and what it lacks")
    handshake.description = "One line of JSON: versions, packages and their pins, what is missing, how to fix it."
    _make_task(handshake, commands.handshake)
    _add_set_up(known.add_parser("set-up", help="make a Python environment with everything that the engine needs"))
    _add_add(known.add_parser("add", help="add optional parts to this engine: making masks, poses, readers"))
    warm_up = known.add_parser("warm-up", help="compile what a lift runs, so that the first one starts at once")
    warm_up.description = "Compile for this machine what a lift runs. It takes half a minute, once; set-up does it too."
    _make_task(warm_up, commands.warm_up)
    return parser


def _add_lift(parser: argparse.ArgumentParser) -> None:
    parser.description = "With -o: lift a scene into a new folder. Without -o: run the lift that a folder asks for."
    parser.add_argument("scene", type=Path, metavar="SCENE|LIFT", help="the scene (with -o), or a lift folder")
    parser.add_argument("-o", "--output", type=Path, metavar="OUT", help="the lift folder to make")
    request.add_lift_options(parser)
    parser.add_argument("--resume", action="store_true", help="continue a lift that was stopped")
    _add_download(parser)
    parser.add_argument(
        "--refine", nargs="?", const="preview", choices=[name for name in PRESETS if name != "draft"], metavar="PRESET",
        help="go on from a finished lift in LIFT, without -o, by a better preset (default: preview)",
    )  # fmt: skip
    request.add_progress_option(parser)
    _add_relink(parser)
    _add_stay_with_parent(parser)
    parser.set_defaults(run=commands.lift)


def _add_bake(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Render frames of a finished lift, or any cameras, as passes, in addition to the existing ones. What is baked "
        "is kept if this is stopped. Several processes may bake one lift at once: each view is baked by one of them."
    )
    parser.epilog = (
        'A file of cameras is a JSON list of objects such as {"name": "shot.0001", "width": 1920, "height": 1080, '
        '"K": [[1500, 0, 960], [0, 1500, 540], [0, 0, 1]], "camera_to_world": [[..], [..], [..], [0, 0, 0, 1]], '
        '"clip": [0.1, 100]}: OpenCV axes (x right, y down, z forward) in the lift\'s world in metres, z up, pixels '
        "with their centres at +0.5. fx, fy, cx and cy may be given instead of K; clip may be left out. frame, fps and "
        "display ([left, top, width, height], the window of the picture that viewers show) are for the header. The "
        "passes go to result/passes/NAME.exr, or to FOLDER/NAME.exr. A view is baked again if its camera has changed, "
        "or if it lacks a chosen layer."
    )
    parser.add_argument("lift", type=Path, metavar="LIFT", help="the folder of a finished lift")
    parser.add_argument(
        "--frames", nargs="+", metavar="FRAME",
        help="names of frames, the numbers in their names (10-200:2 or 7,9), test (the held-out ones), or "
        "all (default, without --cameras)",
    )  # fmt: skip
    parser.add_argument("--cameras", type=Path, metavar="FILE.json", help="cameras to bake from, see below")
    parser.add_argument(
        "--layers", nargs="+", choices=FURTHER_LAYERS, default=(), metavar="LAYER",
        help=f"layers to write in addition to the standard ones: {', '.join(FURTHER_LAYERS)}",
    )  # fmt: skip
    parser.add_argument(
        "--channels", choices=CHANNELS, default="blender", help="the program whose channel names to use; nuke needs -o"
    )
    parser.add_argument(
        "-o", "--output", type=Path, metavar="FOLDER",
        help="write FOLDER/NAME.exr, and leave the lift's result unchanged (default: write into the result)",
    )  # fmt: skip
    parser.add_argument("--replace", action="store_true", help="overwrite other programs' files in FOLDER, too")
    parser.add_argument(
        "--without", nargs="+", default=(), metavar="OBJECT",
        help="a clean plate: bake the room without these objects, and keep no correction; needs -o",
    )  # fmt: skip
    _add_relink(parser)
    _add_place_options(parser)
    parser.set_defaults(run=commands.bake)


def _add_export(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "coco: COCO panoptic (panoptic.json, panoptic/). instances: 16-bit PNGs of classes and instances, and in "
        "colours. scannet: label-filt/ and instance-filt/. points: the labelled points and Gaussians (PLY). splats: "
        "Gaussians alone (PLY, SPZ, GLB). boxes: the objects' boxes (JSON, CSV). mesh: the "
        "surface, cut into one mesh per instance and per stuff class (PLY, GLB). gltf: these in one file (GLB). usd: "
        "Gaussians, meshes, boxes and cameras (OpenUSD). depth: a map in metres per frame (NPY), as lift --depth takes "
        "it. clouds: the pixels of a frame, or of any camera, as labelled points (NPZ). Frames that are not baked are "
        "rendered."
    )
    parser.add_argument("lift", type=Path, metavar="LIFT", help="the folder of a finished lift")
    parser.add_argument("--to", required=True, choices=EXPORTS, help="what to write")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FOLDER", help="where to write it")
    parser.add_argument(
        "--frames", nargs="+", default=["all"], metavar="FRAME", help="as for bake: names, ranges, test, or all"
    )
    parser.add_argument("--cameras", type=Path, metavar="FILE.json", help="as for bake, instead of frames; for clouds")
    parser.add_argument(
        "--objects", nargs="+", default=(), metavar="NAME",
        help='only these instances or classes, such as "chair 1" or floor; for splats, boxes, gltf and usd',
    )  # fmt: skip
    _add_relink(parser)
    _make_task(parser, commands.export, "What was exported so far is kept.")


def _make_task(parser: argparse.ArgumentParser, run: Run, when_stopped: str = "") -> None:
    """Make a command run as a task that other programs can follow. ``when_stopped`` says what is left after a stop."""
    parser.add_argument("--json", action="store_true", help="print the answer as one line of JSON, for programs")
    _add_place_options(parser)
    parser.set_defaults(run=run, is_task=True, when_stopped=when_stopped)


def _add_relink(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--scene", type=Path, metavar="SCENE", dest="relink",
        help="where the scene of LIFT is now, if it was moved; its frames are compared, and the lift remembers it",
    )  # fmt: skip


def _add_place_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--events", type=Path, metavar="FILE.jsonl",
        help="write progress and the answer there as events, and all output to FILE.log; FILE.cancel stops it",
    )  # fmt: skip
    request.add_progress_option(parser)
    _add_stay_with_parent(parser)


def _add_stay_with_parent(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--stay-with-parent", action="store_true", help="stop when standard input ends (a parent holds it open)"
    )


def _add_evaluate(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "LIFT: check a finished lift's files against its manifest and print its metrics. With --predictions and "
        "--truth: the same metrics of any labels, as COCO panoptic (panoptic.json and panoptic/) or PNGs of class ids "
        "and of instance ids (class/ and instance/, semantic/ and instance/, gt/, rs_*, m2f_*, *-filt)."
    )
    parser.add_argument("lift", type=Path, nargs="?", metavar="LIFT", help="the folder of a finished lift")
    parser.add_argument("--predictions", type=Path, metavar="FOLDER", help="labels to score")
    parser.add_argument("--truth", type=Path, metavar="FOLDER", help="the true labels of the same frames")
    parser.add_argument(
        "--ids-per-frame", action="store_true", help="the predictions' instance ids are valid only within a frame"
    )
    parser.add_argument("--classes", action="store_true", help="also show each class")
    _make_task(parser, commands.evaluate)


def _add_inspect(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Read a scene as a lift would, describe it, and measure what is wrong with it: axes, poses, depth, intrinsics, "
        "order, drift, up, pictures, labels. Bad input gives one line and exit code 2."
    )
    parser.add_argument("scene", type=Path, metavar="SCENE", help="the scene's folder")
    request.add_scene_options(parser)
    parser.add_argument("--preset", choices=PRESETS, help="also predict what a lift with this preset would take")
    parser.add_argument("-o", "--output", type=Path, metavar="FOLDER", help="write findings and their pictures there")
    parser.add_argument("--fix", type=Path, metavar="OUT", help="write the scene to a new folder, fixed where safe")
    _make_task(parser, commands.inspect)


def _add_frames(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "colour: pictures from a video or an archive, or with lens distortion, as undistorted JPEGs. depth, masks: "
        "drawn in colours. cloud: what depth shows, as coloured points (cloud.npz). frames.json lists them all. What "
        "exists already is kept. Blender shows these if it cannot read the scene itself."
    )
    parser.add_argument("scene", type=Path, metavar="SCENE", help="the scene's folder or file")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FOLDER", help="where to write")
    parser.add_argument("--make", nargs="+", choices=FRAME_FILES, default=list(FRAME_FILES), help="what (default: all)")
    parser.add_argument("--frames", nargs="+", metavar="FRAME", help="only these frames; the cloud is made of all")
    request.add_scene_options(parser)
    _make_task(parser, commands.frames, "What was made is kept. Give the same command again to continue.")


def _add_classes(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "List the classes in the masks' files and in a classes.toml beside them. --write takes an edited list in the "
        "form of --json, and writes classes.toml, which every later lift reads."
    )
    parser.add_argument("scene", type=Path, metavar="SCENE", help="the scene's folder or file")
    parser.add_argument("--table", metavar="NAME", help="start over with the classes of a public table")
    parser.add_argument("--write", type=Path, metavar="FILE.json", help="write the list in this file")
    request.add_scene_options(parser)
    _make_task(parser, commands.classes)


def _add_find_scene(parser: argparse.ArgumentParser) -> None:
    parser.description = "The scene's frames are compared with those of the lift. Other scenes are refused."
    parser.add_argument("lift", type=Path, metavar="LIFT", help="the lift's folder")
    parser.add_argument("scene", type=Path, metavar="SCENE", help="the scene's folder or file")
    _make_task(parser, commands.find_scene)


def _add_poses(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Let COLMAP (the package pycolmap) find the poses of photos that overlap, taken by one camera, and write them "
        "beside the photos as sparse/0, which a lift reads. The sharpest pictures of a film go into a folder with its "
        "name. Depth maps of the photos in SCENE/depth (PNG in millimetres, or NPY in metres) give the unit of length."
    )
    parser.add_argument("scene", type=Path, metavar="SCENE", help="a folder with photos, or a film")
    most = "the most pictures to take from a film (default: 150)"
    parser.add_argument("--pictures", type=request.number_of_frames, metavar="N", help=most)
    _make_task(parser, commands.poses, "Nothing was written.")


def _add_segment(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Let a network of transformers (Mask2Former, OneFormer, EoMT, RF-DETR) make a panoptic mask of every frame: "
        "panoptic.json and panoptic/, which a lift reads, and detections.json. Existing masks are never overwritten. "
        "If this is stopped, the same command continues. Known networks:\n" + listing(each.name for each in MASKS)
    )
    parser.add_argument("scene", type=Path, metavar="SCENE", help="the scene's folder or file")
    _add_model(parser, "such a network", SEGMENT_MODEL)
    parser.add_argument(
        "--merge", choices=("one", "two"), default="one",
        help="two: what is surer than 0.25 fills what the first round, above 0.5, left (default: one)",
    )  # fmt: skip
    parser.add_argument(
        "-o", "--output", type=Path, metavar="FOLDER", help="where to write the masks (default: the scene's folder)"
    )
    parser.add_argument(
        "--frames", choices=("auto", "all"), default="all",
        help="auto: the sharpest frames that together see every surface five times, the others get empty masks; "
        "all makes those later (default: all)",
    )  # fmt: skip
    request.add_options(parser, "up", "scene_format")
    _make_task(parser, commands.segment, "Give the same command again to continue.")


def _add_prepare(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Make the poses, the depth and the masks of a film or of photos, each only where it is missing, in a folder of "
        "the film's name, or beside the photos. lift FILM -o OUT does this first. What must be downloaded is listed "
        "with its size and licence, and fetched with --download only. If this is stopped, the same command continues."
    )
    parser.add_argument("scene", type=Path, metavar="FILM|PHOTOS", help="a film, or a folder with photos")
    _add_download(parser)
    parser.add_argument("--masks-model", default=SEGMENT_MODEL, metavar="NAME|FOLDER", help="as segment --model")
    parser.add_argument("--depth-model", default=DEPTH[0].name, metavar="NAME|FOLDER", help="as depth --model")
    parser.add_argument("--have", nargs="+", choices=("depth", "masks"), default=(), help="what not to make")
    _make_task(parser, commands.prepare, "Give the same command again to continue.")


def _add_model(parser: argparse.ArgumentParser, network: str, default: str) -> None:
    about = f"a folder with {network}, or its name on Hugging Face's hub (default: {default})"
    parser.add_argument("--model", default=default, metavar="NAME|FOLDER", help=about)
    _add_download(parser)


def _add_download(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--download", action="store_true",
        help="download networks from huggingface.co; otherwise they must be on this machine already",
    )  # fmt: skip


def _add_depth(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Let a network make depth of every photo, fit it to the points of the reconstruction and to the other frames, "
        "and write it to made_depth beside them, where every command reads it. What the frames contradict gets no "
        "depth. If this is stopped, the same command continues. Known networks:\n"
        + listing(each.name for each in DEPTH)
    )
    parser.add_argument("scene", type=Path, metavar="SCENE", help="the scene's folder or file")
    _add_model(parser, "a network for depth", DEPTH[0].name)
    request.add_options(parser, "up", "scene_format")
    _make_task(parser, commands.depth, "Give the same command again to continue.")


def _add_scale(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Multiply the lengths of a scene, as poses of COLMAP or of photogrammetry have no unit: by FACTOR, or so that "
        "a distance that is LENGTH now becomes METRES. Every command reads scale.json in the scene's folder."
    )
    parser.add_argument("scene", type=Path, metavar="SCENE", help="the scene's folder or file")
    either = parser.add_mutually_exclusive_group(required=True)
    either.add_argument("--factor", type=float, metavar="FACTOR", help="replaces an earlier scale")
    either.add_argument(
        "--measured", type=float, nargs=2, metavar=("LENGTH", "METRES"), help="on top of an earlier scale"
    )
    request.add_options(parser, "up", "scene_format")
    _make_task(parser, commands.scale)


def _add_set_up(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Make an environment in FOLDER with the pinned packages, about 1.3 GB, and compile what a lift runs. Any "
        "Python that PLGS supports can run this. If it is stopped or interrupted, the same command continues."
    )
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="where environments, their log and lock are")
    parser.add_argument("--base-python", type=Path, metavar="PYTHON", help="make it from this Python")
    parser.add_argument("--torch", choices=("cpu", "cuda"), default="cpu", help="the build of torch (default: cpu)")
    about = "the SHA-256 of torch's wheel in --wheels, where PLGS knows none"
    parser.add_argument("--torch-hash", default="", metavar="SHA256", help=about)
    either = parser.add_mutually_exclusive_group()
    _add_wheels(either)
    either.add_argument(
        "--download", type=Path, metavar="DIR",
        help="only collect the wheels for this, and for all that 'add' can add, in DIR, for this system and Python",
    )  # fmt: skip
    either.add_argument("--remove", action="store_true", help="delete the environments in FOLDER instead")
    _make_task(parser, commands.set_up, "Downloads are kept. Give the same command again to continue.")


def _add_add(parser: argparse.ArgumentParser) -> None:
    parts = ", ".join(f"{name} ({CAPABILITIES[name].label}, {CAPABILITIES[name].size / 1e6:.0f} MB)" for name in ADDED)
    parser.description = (
        f"Add the pinned packages of one ability to the environment of the Python that runs this: {parts}. "
        "If this is stopped or fails, the environment stays as it was."
    )
    parser.add_argument(
        "name", choices=(*ADDED, *ALSO_ADDED), metavar="NAME", help=f"one of {', '.join((*ADDED, *ALSO_ADDED))}"
    )
    _add_wheels(parser)
    _make_task(parser, commands.add, "The engine is unchanged.")


def _add_wheels(parser: argparse._ActionsContainer) -> None:
    about = "install the wheels in DIR, without a network; 'set-up FOLDER --download DIR' collects them"
    parser.add_argument("--wheels", type=Path, metavar="DIR", help=about)


def _add_presets(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Without NAME: list the presets. With NAME: print all options of one as TOML. Saved with changes, this makes a "
        "file for lift --preset FILE.toml."
    )
    parser.add_argument("name", nargs="?", type=request.preset_or_file, metavar="NAME|FILE.toml", help="a preset")
    request.add_set_option(parser)
    parser.add_argument("--json", action="store_true", help="for programs: the table of all options, or NAME's values")
    parser.set_defaults(run=commands.presets)


READER_GONE = 141  # 128 + SIGPIPE
"""The shell's exit status of a command whose reader has ended, such as ``head``."""


def main(arguments: Sequence[str], parser: Callable[[], argparse.ArgumentParser] = make_parser) -> int:
    """Run a command and return its exit code. Bad arguments raise SystemExit(2), as usual with argparse."""
    _open_missing_streams()
    try:
        try:
            return _run(arguments, parser())
        finally:
            sys.stdout.flush()  # flushed here, where a closed reader is not yet an error
    except BrokenPipeError:
        drop_output()
        return READER_GONE
    except OSError as error:
        failure = failure_of(error, Command("", lambda events, stop: None))
        print(printable(f"error: {failure}"), file=sys.stderr)
        drop_output()
        return failure.exit_code
    except RuntimeError as error:  # raised by Python before 3.13 for links in a circle
        if not str(error).startswith("Symlink loop"):
            raise
        print(printable(f"error: a link leads to itself: {error}. Fix or remove it."), file=sys.stderr)
        return ExitCode.BAD_INPUT


def _open_missing_streams() -> None:
    """Open closed standard streams on the null device; otherwise files opened next would take their numbers."""
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:  # the lowest number that is free
        os.set_inheritable(number, True)  # as standard streams are, for the programs that it starts
    os.close(number)
    for name, mode, number in (("stdin", "r", 0), ("stdout", "w", 1), ("stderr", "w", 2)):
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, mode, encoding="utf-8", errors="replace", closefd=False))


def _run(arguments: Sequence[str], parser: argparse.ArgumentParser) -> int:
    options = parser.parse_args(request.readable(arguments))
    options.echo = stdout_for_events(vars(options).get("progress", "text"))  # not every command has it
    try:
        refuse_small_memory()
        if not vars(options).get("is_task"):
            with Interrupts():
                return int(options.run(options))
        files = None if options.events is None else TaskFiles.at(options.events)
        pipe = sys.stdin.fileno() if options.stay_with_parent else None
        how = {"when_stopped": options.when_stopped, "parent_pipe": pipe, "echo": options.echo}
        return run_task(Command(options.command, partial(options.run, options), **how), files, as_json=options.json)
    except PlgsError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    except Interrupted as error:  # in commands that leave nothing to continue
        print("Stopped.", file=sys.stderr)
        return error.exit_code
