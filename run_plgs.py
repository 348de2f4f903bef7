"""Lift a scene and put the result into a .blend, without a window. Either of

    blender -b --python-exit-code 1 --python run_plgs.py -- SCENE -o OUT
    python run_plgs.py SCENE -o OUT          (a Python that has the bpy module, or with `make set-up` done)

Bake passes of a finished lift from a camera of a .blend, frame by frame (by default the file that Blender has opened,
else the lift's own, and its active camera; frames that are already baked are kept):

    blender -b FILE.blend --python-exit-code 1 --python run_plgs.py -- -o OUT --bake camera ...
    python run_plgs.py -o OUT --bake camera [--blend FILE.blend] [--camera NAME] [--range FIRST-LAST] [--passes FOLDER]

Exit codes: 0 finished, 1 internal error (see the log), 2 bad input, 3 cancelled, 75 another engine is running there
(try again), 129 the terminal was closed, 130 Ctrl-C, 141 finished, but nobody read the output to its end, 143 SIGTERM.
--resume continues what was cancelled or interrupted.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import signal
import subprocess
import sys
import traceback
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from types import ModuleType
from typing import NoReturn

if sys.version_info < (3, 11):  # noqa: UP036 - said here, because the imports that follow fail without a reason
    print("error: Python 3.11 or newer is needed. Run 'make set-up', then .venv/bin/python run_plgs.py ...")
    sys.exit(2)

if __name__ == "__main__" and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # until `Interrupts` is in place, Ctrl-C just ends it

ROOT = Path(__file__).resolve().parent
BLEND_S = 600.0
"""Seconds that a command waits for its turn while others build the .blend of the same lift."""
MOST_FRAMES = 1_000_000
"""The most frames of a shot."""
_OF_A_CAMERA = ("blend", "camera", "shot", "replace", "camera_frames", "layers", "passes", "channels")
"""Options of --bake camera only."""
READER_GONE = 141
"""The shell's exit status of a command whose reader has ended, such as ``head``."""


def load_package() -> None:
    """Make this script's folder importable as ``plgs``, whatever it is called."""
    # Not by its own __init__: that imports bpy, for which a typing error in the command line should not have to wait.
    package = ModuleType("plgs")
    package.__path__ = [str(ROOT)]
    sys.modules.setdefault("plgs", package)


load_package()
# ruff: noqa: E402 - what follows can be imported only now
from plgs.engine.errors import ExitCode, PlgsError
from plgs.engine.gates import open_plain, open_to_append
from plgs.engine.job import CHANNELS, FURTHER_LAYERS, LiftFolder, read_manifest
from plgs.engine.job.cameras import frame_numbers
from plgs.engine.job.lock import FileLock
from plgs.engine.job.process import clean_environment, engine_python, missing_modules
from plgs.engine.job.report import estimated_text, made_files, metrics_text, read_metrics
from plgs.engine.job.request import Parser, add_lift_options, add_progress_option, given_lift_options, readable
from plgs.engine.job.terminal import Interrupted, Interrupts, ask_engine, lift_in_terminal, stdout_for_events


def script_arguments(argv: Sequence[str]) -> list[str]:
    """Return the arguments for this script: those after ``--``. Without ``--``, return all, or none inside Blender."""
    if "--" in argv:
        return list(argv[argv.index("--") + 1 :])
    blender = sys.modules.get("bpy")
    return [] if blender is not None and blender.app.binary_path else list(argv[1:])


def main(arguments: Sequence[str]) -> int:
    """Run the whole script and return the exit code."""
    options = parse(arguments)
    try:
        with Interrupts() as interrupts:
            blender = python_with_blender()
            if blender is None:
                return lift_to_blend(options, interrupts)
        return run_again(blender, arguments)
    except PlgsError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python flushes the rest when it ends
        return READER_GONE
    except Interrupted as interrupted:
        again = "with --resume to continue" if options.scene is not None else "to continue"
        print(f"Stopped. Give the same command again {again}: {options.output}", file=sys.stderr)
        return interrupted.exit_code


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Parse the options. SystemExit(2) if they make no sense, SystemExit(0) after --help."""
    parser = Parser(prog="run_plgs.py", description="Lift a scene and put the result into a .blend.")
    parser.add_argument(
        "scene", type=Path, nargs="?", metavar="SCENE",
        help="folder or file of a capture, in one of the layouts of --format; needed except to bake a camera",
    )  # fmt: skip
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="OUT", help="the lift's folder")
    add_lift_options(parser, {"camera": "bake what a camera of a .blend sees of the finished lift, frame by frame"})
    shot = parser.add_argument_group("with --bake camera", "Several processes may bake one lift, each its own frames.")
    shot.add_argument(
        "--blend", type=Path, metavar="FILE.blend",
        help="has the camera (default: the file that Blender opened, else the lift's own)",
    )  # fmt: skip
    shot.add_argument("--camera", default="", metavar="NAME", help="the camera (default: the file's active one)")
    shot.add_argument(
        "--shot", default="", metavar="NAME",
        help="its files' name, perhaps with {shot}, {camera}, {layer}, {version:03d}, and .{frame:04d} at its end "
        "(default: the .blend's and the camera's)",
    )  # fmt: skip
    shot.add_argument(
        "--replace", action="store_true",
        help="replace a shot of this name from another file or camera, and other programs' files in FOLDER",
    )  # fmt: skip
    shot.add_argument(
        "--range", dest="camera_frames", type=frame_range, default=[], metavar="FRAMES",
        help="such as 1-250, 1-250:2, 1-3:0.5, 1001 or 1001,1003 (default: the file's range)",
    )  # fmt: skip
    shot.add_argument(
        "--layers", nargs="+", choices=FURTHER_LAYERS, default=(), metavar="LAYER",
        help=f"layers to write in addition to the standard ones: {', '.join(FURTHER_LAYERS)}",
    )  # fmt: skip
    shot.add_argument(
        "--passes", type=Path, metavar="FOLDER",
        help="write FOLDER/NAME.0001.exr, and leave the lift's result as it is (default: OUT/result/passes)",
    )  # fmt: skip
    shot.add_argument(
        "--channels", choices=CHANNELS, default="", help="the program whose channel names to use (default: blender)"
    )
    shot.add_argument(
        "--scene", type=Path, metavar="SCENE", dest="relink",
        help="where the scene of the lift in OUT is now, if it was moved; the lift remembers it",
    )  # fmt: skip
    parser.add_argument("--save", type=Path, metavar="FILE.blend", help="the .blend (default: OUT/lift.blend)")
    parser.add_argument("--resume", action="store_true", help="continue the stopped lift in OUT, or start it")
    add_progress_option(parser)
    options = parser.parse_args(readable(arguments))
    options.bakes_camera = options.bake == "camera"
    if options.relink is not None and (not options.bakes_camera or options.scene is not None):
        parser.error("--scene belongs to --bake camera without SCENE")
    if options.bakes_camera:
        options.bake = None  # the lift's own passes: as they were, or the defaults
        given = given_lift_options(options)
        if options.scene is None and given:
            parser.error(f"without SCENE nothing is lifted: leave out {', '.join(given)}, or name SCENE")
    elif options.scene is None:
        parser.error("SCENE is needed, unless --bake camera bakes from a finished lift")
    elif any(vars(options)[name] for name in _OF_A_CAMERA):
        belonging = "--blend, --camera, --shot, --replace, --range, --layers, --passes and --channels"
        parser.error(f"{belonging} belong to --bake camera")
    if options.channels == "nuke" and options.passes is None:
        parser.error("--channels nuke needs --passes FOLDER: the lift's own passes are read by Blender")
    return options


def frame_range(text: str) -> list[float]:
    """Return the frames of "1-250", "1-3:0.5" or "1001,1003". Raises ArgumentTypeError, for argparse, for others."""
    try:
        ranges = frame_numbers(text)
        if sum(map(len, ranges)) > MOST_FRAMES:
            raise ValueError(f"{text!r} has more than {MOST_FRAMES} frames")
        thousandths = sorted({frame for each in ranges for frame in each})
        return [frame / 1000 if frame % 1000 else frame // 1000 for frame in thousandths]
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def python_with_blender() -> Path | None:
    """Return a Python that has bpy, or None if the running one has it. Raises PlgsError if none has it."""
    if "bpy" in sys.modules or importlib.util.find_spec("bpy"):
        return None
    python = engine_python()
    if missing_modules(python, ["bpy"]):
        blender = "blender -b --python-exit-code 1 --python run_plgs.py -- ..."
        fix = f"Run 'make set-up' in {ROOT}, or let Blender run this script: {blender}"
        raise PlgsError("no-bpy", "has no bpy, the Blender module", python, fix)
    return python


def run_again(python: Path, arguments: Sequence[str]) -> int:
    """Run the whole command in another Python. On POSIX that Python replaces this process, so that signals reach it."""
    command = [str(python), str(Path(__file__).resolve()), *arguments]
    if os.name == "nt":
        return subprocess.call(command, env=clean_environment())
    os.execve(python, command, clean_environment())


def lift_to_blend(options: argparse.Namespace, interrupts: Interrupts) -> int:
    """Lift, then build the .blend, then print what was made. Raises PlgsError, Interrupted."""
    options.echo = stdout_for_events(options.progress)
    blend, opened = blend_path(options), opened_file()
    if options.bakes_camera and options.blend is None and opened != blend:
        options.blend = opened
    refuse_no_blend(options.blend)
    if options.scene is None:
        lift = LiftFolder.open(options.output)
        read_manifest(lift.result_path)
        if options.relink is not None:
            ask_engine(engine_python(), interrupts, "find-scene", lift.path, options.relink)
        return bake_camera(LiftFolder.open(options.output), blend, options, interrupts)
    lift, code = lift_in_terminal(options, interrupts)
    if code != ExitCode.FINISHED:
        return code
    from plgs.engine.corrections import CORRECTIONS  # late: it needs numpy

    shown = [path for path in (lift.manifest_path, lift.path / CORRECTIONS) if path.exists()]
    made = blend.stat().st_mtime if options.save is None and blend.exists() else 0.0
    if any(path.stat().st_mtime > made for path in shown):
        code = build_blend(lift, blend)
    if code == ExitCode.FINISHED and options.bakes_camera:
        code = bake_camera(lift, blend, options, interrupts)
    if code == ExitCode.FINISHED:
        print(metrics_text(read_metrics(lift)), estimated_text(lift), blend, *made_files(lift), sep="\n", flush=True)
    return code


def opened_file() -> Path | None:
    """Return the .blend that Blender opened before this script; None without one, and in a Python that has bpy."""
    bpy = sys.modules.get("bpy")
    is_blender = bool(getattr(getattr(bpy, "app", None), "binary_path", ""))  # the bpy package has no such path
    return Path(bpy.data.filepath) if bpy is not None and is_blender and bpy.data.filepath else None


def bake_camera(lift: LiftFolder, blend: Path, options: argparse.Namespace, interrupts: Interrupts) -> ExitCode:
    """Bake the camera that the options name; the lift's own .blend then shows the passes. Raises PlgsError."""
    lift.refuse_read_only()
    from plgs.plgs_blender.shot_bakes import bake_shot_in_terminal

    if options.blend is None and not blend.exists():
        build_blend(lift, blend)
    passes = None if options.passes is None else options.passes.absolute()
    code = bake_shot_in_terminal(
        lift, options.blend or blend, options.camera, frames=options.camera_frames, layers=options.layers,
        interrupts=interrupts, echo=options.echo, name=options.shot, replace=options.replace, output=passes,
        channels=options.channels,
    )  # fmt: skip
    shows_them = code == ExitCode.FINISHED and options.blend is None and passes is None
    return build_blend(lift, blend) if shows_them else code


def blend_path(options: argparse.Namespace) -> Path:
    """Return the path of the .blend to write. Raises PlgsError if it could not be written at the end."""
    blend = (options.save or Path(options.output) / "lift.blend").absolute()
    is_in_lift = blend.parent == options.output.absolute()  # which need not exist yet
    if blend.suffix != ".blend" or blend.is_dir():
        what = "is not a name for a .blend"
        raise PlgsError("not-blend", what, blend, "Give --save a file name that ends in .blend.")
    if not is_in_lift and not os.access(blend.parent, os.W_OK):
        what = "cannot be written to, or does not exist"
        raise PlgsError("unwritable", what, blend.parent, "Give --save another folder.")
    if blend.exists() and not is_blend(blend):
        what = "already exists and is not a Blender file"
        raise PlgsError("not-blend", what, blend, "Give --save another file name.")
    return Path(blend)


def refuse_no_blend(named: Path | None) -> None:
    """Raise PlgsError, before anything is lifted, if --blend does not name a .blend."""
    if named is None:
        return
    what = "is not a Blender file" if named.is_file() else "is not there"
    if not named.is_file() or not is_blend(named):
        fix = "Give --blend the Blender file that has the camera."
        raise PlgsError("not-blend", what, named, fix, option="--blend")


def is_blend(path: Path) -> bool:
    """Whether a file begins like a .blend, which may be compressed with zstd or gzip."""
    with open_plain(path) as file:
        return file.read(7).startswith((b"BLENDER", b"\x28\xb5\x2f\xfd", b"\x1f\x8b"))


def build_blend(lift: LiftFolder, blend: Path) -> ExitCode:
    """Make the .blend of a finished lift. It tells an unexpected error in a line; details are in the log. Raises
    PlgsError."""
    lift.refuse_read_only()
    print("Building the .blend ...", file=sys.stderr, flush=True)
    try:
        from plgs.plgs_blender.lift_scene import save_lift  # brings bpy

        (lift.path / "bake").mkdir(exist_ok=True)
        # Commands that were given together also end together.
        with FileLock(lift.path / "bake" / "blend.lock", BLEND_S):
            save_lift(lift.path, blend)
    except PlgsError:
        raise
    except Exception as error:
        with suppress(OSError), os.fdopen(open_to_append(lift.log_path), "a", encoding="utf-8") as log:
            traceback.print_exc(file=log)  # which fails along with the .blend if the disk is full
        what = f"the .blend could not be made ({type(error).__name__}: {error})"
        print(f"error: {what}: {lift.log_path}. --resume tries again; the lift is done.", file=sys.stderr)
        return ExitCode.INTERNAL_ERROR
    return ExitCode.FINISHED


def end(code: int) -> NoReturn:
    """End the process with this exit code."""
    if "bpy" in sys.modules:
        from plgs.plgs_blender.lifecycle import end_process

        end_process(code)
    sys.exit(code)


if __name__ == "__main__":
    end(main(script_arguments(sys.argv)))
