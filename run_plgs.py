"""Lift a scene and put the result into a .blend, without a window. Either of

    blender -b --python-exit-code 1 --python run_plgs.py -- SCENE -o OUT
    python run_plgs.py SCENE -o OUT          (a Python that has the bpy module, or with `make set-up` done)

Passes of a finished lift from a camera of a .blend, frame by frame (the lift's own .blend and its active camera unless
named otherwise; frames that are baked are kept):

    python run_plgs.py -o OUT --bake camera [--blend FILE.blend] [--camera NAME] [--range FIRST-LAST]

Exit codes: 0 finished, 1 internal error (see the log), 2 bad input, 3 cancelled, 130 Ctrl-C. What was cancelled or
interrupted goes on with --resume.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import re
import signal
import subprocess
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    from plgs.engine.job import ExitCode, LiftFolder, LiftRequest
    from plgs.engine.job.terminal import Interrupts

ROOT = Path(__file__).resolve().parent


def load_package() -> None:
    """Make the folder of this script importable as ``plgs``, whatever it is called.

    The extension's own __init__ is for Blender's window: it registers operators, and imports bpy, which a typing error
    in the command line should not have to wait for.
    """
    package = ModuleType("plgs")
    package.__path__ = [str(ROOT)]
    sys.modules.setdefault("plgs", package)


def script_arguments(argv: Sequence[str]) -> list[str]:
    """What is meant for this script: all behind ``--``; without one, in plain Python only, all."""
    if "--" in argv:
        return list(argv[argv.index("--") + 1 :])
    blender = sys.modules.get("bpy")
    return [] if blender is not None and blender.app.binary_path else list(argv[1:])


def main(arguments: Sequence[str]) -> int:
    """The whole run; returns the exit code."""
    load_package()
    from plgs.engine.job import ExitCode, JobError
    from plgs.engine.job.terminal import Interrupted, Interrupts

    options = parse(arguments)
    try:
        with Interrupts() as interrupts:
            blender = python_with_blender()
            if blender is None:
                return lift_to_blend(options, interrupts)
        return run_again(blender, arguments)
    except JobError as error:
        print(f"error: {error}", file=sys.stderr)
        return ExitCode.BAD_INPUT
    except Interrupted as interrupted:
        again = "with --resume to go on" if options.scene is not None else "to go on"
        print(f"Stopped. Give the same command {again}: {options.output}", file=sys.stderr)
        return interrupted.exit_code


class Parser(argparse.ArgumentParser):
    """One whose errors are a line, without the usage."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"error: {message}. --help tells all options.\n")


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """The options; SystemExit(2) when they make no sense, SystemExit(0) after --help."""
    from plgs.engine.job.options import add_lift_options, given_lift_options, readable

    parser = Parser(prog="run_plgs.py", description="Lift a scene and put the result into a .blend.")
    parser.add_argument(
        "scene", type=Path, nargs="?", metavar="SCENE",
        help="folder or file of a capture, in one of the layouts of --format; needed but to bake a camera",
    )  # fmt: skip
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="OUT", help="the lift folder to make; all results go there"
    )
    add_lift_options(parser, {"camera": "what a camera of a .blend sees, frame by frame, of the finished lift"})
    shot = parser.add_argument_group("with --bake camera", "Several processes may bake one lift, each its own frames.")
    shot.add_argument("--blend", type=Path, metavar="FILE.blend", help="has the camera (default: the lift's own)")
    shot.add_argument("--camera", default="", metavar="NAME", help="the camera (default: the file's active one)")
    shot.add_argument(
        "--range", dest="camera_frames", type=frame_range, default=(None, None, None), metavar="FIRST-LAST[xSTEP]",
        help="such as 1-250 or 1-250x2 (default: the file's range)",
    )  # fmt: skip
    parser.add_argument("--save", type=Path, metavar="FILE.blend", help="the .blend (default: OUT/lift.blend)")
    parser.add_argument(
        "--resume",
        action="store_true",
        help="go on with the lift in OUT that was stopped or killed; start it when there is none",
    )
    options = parser.parse_args(readable(arguments))
    options.bakes_camera = options.bake == "camera"
    if options.bakes_camera:
        options.bake = None  # of the lift itself, that is as it was, or the default
        given = given_lift_options(options)
        if options.scene is None and given:
            parser.error(f"without SCENE nothing is lifted: leave out {', '.join(given)}, or name SCENE")
    elif options.scene is None:
        parser.error("SCENE is needed, unless --bake camera bakes from a lift that is finished")
    elif options.blend or options.camera or options.camera_frames != (None, None, None):
        parser.error("--blend, --camera and --range belong to --bake camera")
    return options


def frame_range(text: str) -> tuple[int, int, int]:
    """(first, last, step) from "1-250" or "1-250x2"; for argparse, so it raises ArgumentTypeError."""
    found = re.fullmatch(r"(\d{1,7})-(\d{1,7})(?:x([1-9]\d{0,6}))?", text)
    if found is None:
        raise argparse.ArgumentTypeError(f"{text!r} is no range of frames from 0 on, such as 1-250 or 1-250x2")
    if int(found[2]) < int(found[1]):
        raise argparse.ArgumentTypeError(f"{text!r} ends before it begins; a range is such as 1-250")
    return int(found[1]), int(found[2]), int(found[3] or 1)


def python_with_blender() -> Path | None:
    """None when this Python has bpy, else one that has. Raises JobError when there is none."""
    from plgs.engine.job import JobError
    from plgs.engine.job.process import engine_python, missing_modules

    if "bpy" in sys.modules or importlib.util.find_spec("bpy"):
        return None
    python = engine_python()
    if missing_modules(python, ["bpy"]):
        fix = f"Run 'make set-up' in {ROOT}, or let Blender run this script: blender -b --python run_plgs.py -- ..."
        raise JobError("has no bpy, the Blender module", python, fix)
    return python


def run_again(python: Path, arguments: Sequence[str]) -> int:
    """Let another Python do it all; on POSIX it takes this process's place, so signals reach it."""
    from plgs.engine.job.process import clean_environment

    command = [str(python), str(Path(__file__).resolve()), *arguments]
    if os.name == "nt":
        return subprocess.call(command, env=clean_environment())
    os.execve(python, command, clean_environment())


def lift_to_blend(options: argparse.Namespace, interrupts: Interrupts) -> int:
    """Lift, then build the .blend, then tell what was made. Raises JobError, Interrupted."""
    from plgs.engine.job import ExitCode, JobError
    from plgs.engine.job.session import lift_in_terminal
    from plgs.engine.scene import SceneError

    blend = blend_path(options)
    refuse_no_blend(options.blend)
    try:
        if options.scene is None:
            return bake_camera(finished_lift(options.output), blend, options, interrupts)
        lift, code = lift_in_terminal(options, interrupts, check_scene_folder)
        if code != ExitCode.FINISHED:
            return code
        if options.save is not None or is_older(blend, lift.manifest_path):
            code = build_blend(lift, blend)
        if code == ExitCode.FINISHED and options.bakes_camera:
            code = bake_camera(lift, blend, options, interrupts)
    except SceneError as error:
        raise JobError(error.what, error.where, error.fix) from error
    if code == ExitCode.FINISHED:
        tell_what_was_made(lift, blend)
    return code


def tell_what_was_made(lift: LiftFolder, blend: Path) -> None:
    from plgs.engine.job.report import made_files, metrics_table

    print(metrics_table(lift), "", blend, *made_files(lift), sep="\n", flush=True)


def finished_lift(folder: Path) -> LiftFolder:
    """Raises JobError when there is none."""
    from plgs.engine.job import LiftFolder, read_manifest

    lift = LiftFolder.open(folder)
    read_manifest(lift.result_path)
    return lift


def bake_camera(lift: LiftFolder, blend: Path, options: argparse.Namespace, interrupts: Interrupts) -> ExitCode:
    """Bake the camera that the options name; the lift's own .blend then shows the passes. Raises JobError."""
    from plgs.engine.job import ExitCode
    from plgs.plgs_blender.shot_baking import bake_shot_in_terminal  # brings bpy

    if options.blend is None and not blend.exists():
        build_blend(lift, blend)
    code = bake_shot_in_terminal(lift, options.blend or blend, options.camera, options.camera_frames, interrupts)
    if code != ExitCode.FINISHED:
        return code
    return build_blend(lift, blend) if options.blend is None or blend.exists() else code


def check_scene_folder(request: LiftRequest) -> None:
    """The quick look, before any folder is made. Raises SceneError."""
    from plgs.engine.scene import open_scene_to_lift

    open_scene_to_lift(request)


def blend_path(options: argparse.Namespace) -> Path:
    """Where the .blend goes. Raises JobError when it could not be written at the end."""
    from plgs.engine.job import JobError

    if options.save is None:
        return Path(options.output).absolute() / "lift.blend"
    blend: Path = options.save.absolute()
    is_in_lift = blend.parent == options.output.absolute()  # which need not be there yet
    if blend.suffix != ".blend" or blend.is_dir():
        raise JobError("is no name for a .blend", blend, "Give --save a file name that ends in .blend.")
    if not is_in_lift and not os.access(blend.parent, os.W_OK):
        raise JobError("cannot be written to, or is not there", blend.parent, "Give --save another folder.")
    if blend.exists() and not is_blend(blend):
        raise JobError("is there already and is no Blender file", blend, "Give --save another file name.")
    return blend


def refuse_no_blend(named: Path | None) -> None:
    """Raises JobError for what --blend names and is no .blend: before anything is lifted."""
    from plgs.engine.job import JobError

    if named is None:
        return
    if not named.is_file():
        raise JobError("is not there", named, "Give --blend the Blender file that has the camera.")
    if not is_blend(named):
        raise JobError("is no Blender file", named, "Give --blend the Blender file that has the camera.")


def is_blend(path: Path) -> bool:
    """Whether a file begins as a .blend does: as it is, or compressed by zstd or gzip."""
    from plgs.engine.gates import open_plain

    with open_plain(path) as file:
        return file.read(7).startswith((b"BLENDER", b"\x28\xb5\x2f\xfd", b"\x1f\x8b"))


def is_older(path: Path, than: Path) -> bool:
    """Whether ``path`` is missing or was made before ``than``."""
    return not path.exists() or path.stat().st_mtime < than.stat().st_mtime


def build_blend(lift: LiftFolder, blend: Path) -> ExitCode:
    """Make the .blend. An error becomes a line, its details go to the log; the lift itself stays finished."""
    from plgs.engine.gates import open_to_append
    from plgs.engine.job import ExitCode, JobError
    from plgs.engine.scene import SceneError

    print("Building the .blend ...", file=sys.stderr, flush=True)
    try:
        from plgs.plgs_blender.lift_scene import save_lift  # brings bpy

        save_lift(lift.path, blend)
    except (JobError, SceneError):
        raise
    except Exception as error:
        with os.fdopen(open_to_append(lift.log_path), "a", encoding="utf-8") as log:
            traceback.print_exc(file=log)
        what = f"the .blend could not be made ({type(error).__name__}: {error})"
        print(f"error: {what}: {lift.log_path}. --resume tries again; the lift is done.", file=sys.stderr)
        return ExitCode.INTERNAL_ERROR
    return ExitCode.FINISHED


def end(code: int) -> NoReturn:
    """End the process with this exit code."""
    if "bpy" in sys.modules:
        from plgs.plgs_blender.module_exit import end_process

        end_process(code)
    sys.exit(code)


if __name__ == "__main__":
    if sys.version_info < (3, 11):  # noqa: UP036 - said here, because the imports in main say it in riddles
        print("error: Python 3.11 or newer is needed. Run 'make set-up', then .venv/bin/python run_plgs.py ...")
        sys.exit(2)
    if (
        signal.getsignal(signal.SIGINT) is signal.default_int_handler
    ):  # until `Interrupts` is there, Ctrl-C just ends it
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    end(main(script_arguments(sys.argv)))
