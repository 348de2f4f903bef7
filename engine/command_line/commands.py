"""The functions that commands run. The modules that they need load numpy and more, so these are imported when a command
runs, not for --help or a mistyped command."""

from __future__ import annotations

import argparse
import json
import math
import os
import shlex
import sys
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import PlgsError
from ..gates import shortened
from ..job import EventWriter, ExitCode, LiftFolder, StopSignal, verify
from ..job.request import chosen_options, given_lift_options, source_of
from ..job.studio import filled_in
from ..job.task import TaskFiles
from ..json_file import Json
from ..presets.options import option_value, parsed_options, preset_options, preset_text, with_options
from ..presets.preset import PRESETS
from ..records import to_json

if TYPE_CHECKING:
    from ..scene import Scene


def lift(options: argparse.Namespace) -> int:
    """Lift a scene: with -o by a second process, whose progress is shown, otherwise in this one."""
    if options.output:
        if options.relink is not None:
            fix = "Give LIFT, --scene and --resume, without -o."
            raise PlgsError("scene-option", "is only for an existing lift folder", "--scene", fix)
        if options.refine is not None:
            what = "needs a finished lift, but -o makes a new one"
            raise PlgsError("refine-new", what, "--refine", "Give LIFT without -o, or --preset for a new lift.")
        return _lift_in_terminal(options)
    from .run_engine import run_engine

    if options.relink is not None:
        _opened(options.scene, options.relink)
    if os.path.exists(options.scene) and not (options.scene / "request.json").exists():
        what, fix = "is not a lift folder (it has no request.json)", "To lift a scene, name a new folder with -o."
        raise PlgsError("not-lift-folder", what, options.scene.absolute(), fix, option="-o")
    given = given_lift_options(options)
    if given:
        fix = "Leave them out, or lift a scene into a new folder with -o."
        raise PlgsError("request-fixed", "an existing lift keeps its options", ", ".join(given), fix)
    folder = LiftFolder.open(options.scene)
    if options.refine is not None:
        folder = folder.refined(options.refine)
    pipe = _parent_pipe(options, folder)
    own = getattr(options, "lift", None)  # set by another program that has its own way to lift
    resume = options.resume or options.refine is not None
    code = run_engine(folder, resume=resume, parent_pipe=pipe, echo=options.echo, lift=own)
    if code is ExitCode.FINISHED and pipe is None:
        _print_made(folder)
    return code


def _print_made(lift: LiftFolder) -> None:
    """Print how well a finished lift did, and its files."""
    from ..job.report import estimated_text, made_files, metrics_text, read_metrics

    told = estimated_text(lift)
    print(metrics_text(read_metrics(lift)), *([told] if told else []), "", *made_files(lift), sep="\n")
    blend = lift.path / "lift.blend"  # of run_plgs.py; the engine has no Blender
    if blend.is_file() and blend.stat().st_mtime < lift.manifest_path.stat().st_mtime:
        again = shlex.join(["run_plgs.py", str(lift.request.scene), "-o", str(lift.path), "--resume"])
        print(f"warning: {blend} shows the earlier result; to make it anew: {again}", file=sys.stderr)


def _lift_in_terminal(options: argparse.Namespace) -> int:
    from ..job.terminal import Interrupted, Interrupts, lift_in_terminal

    try:
        with Interrupts() as interrupts:
            lift, code = lift_in_terminal(options, interrupts)
    except Interrupted as error:
        print(f"Stopped. Give the same command with --resume to continue: {options.output}", file=sys.stderr)
        return error.exit_code
    if code is ExitCode.FINISHED:
        _print_made(lift)
    return code


def bake(options: argparse.Namespace) -> ExitCode:
    """Bake passes in this process, which is the engine."""
    from ..job import read_cameras
    from .run_engine import run_bake

    folder = _opened(options.lift, options.relink)
    frames = options.frames if options.frames or options.cameras else ["all"]
    if options.channels != "blender" and options.output is None:
        what, fix = "Blender cannot read passes with other channel names in a lift", "Name another folder with -o."
        raise PlgsError("channels-of-result", what, options.lift, fix, option="-o")
    if options.without and options.output is None:
        what, fix = "--without would replace the lift's own passes", "Give a folder for the new passes with -o."
        raise PlgsError("without-in-result", what, options.lift, fix, option="-o")
    if options.cameras is not None:
        if not options.cameras.is_file():  # perhaps a camera's name, as "--camera NAME" is read as "--cameras"
            fix = "--help explains what such a file holds; run_plgs.py --bake camera bakes the cameras of a .blend."
            raise PlgsError("no-cameras-file", "the camera file does not exist", options.cameras, fix)
        read_cameras(options.cameras)  # so that errors are reported at once, not after the model was read
    files = None if options.events is None else TaskFiles.at(options.events)
    pipe = _parent_pipe(options, folder)
    return run_bake(
        folder, frames, cameras=options.cameras, layers=options.layers, output=options.output, parent_pipe=pipe,
        channels=options.channels, replace=options.replace, without=options.without, files=files, echo=options.echo,
    )  # fmt: skip


def _opened(lift: Path, scene: Path | None) -> LiftFolder:
    """Open the lift in a folder, after changing its scene's path to ``scene``, if given."""
    folder = LiftFolder.open(lift)
    if scene is None:
        return folder
    from ..scene_of_lift import relink

    return relink(folder, scene)


def _parent_pipe(options: argparse.Namespace, folder: LiftFolder) -> int | None:
    if options.stay_with_parent:
        return sys.stdin.fileno()
    print(f"The engine's output goes to {folder.log_path}", flush=True)
    return None


def export(options: argparse.Namespace, events: EventWriter, stop: StopSignal) -> None:
    folder = _opened(options.lift, options.relink)
    from ..export.run import export
    from ..job.progress import StageProgress

    events.stage("export", 1, 1, "Exporting")
    export(
        folder, options.to, options.output, options.frames, progress=StageProgress("export", events, stop),
        cameras=options.cameras, objects=options.objects, warn=events.warning,
    )  # fmt: skip
    events.answer({"output": options.output}, f"Exported to {options.output}")


def evaluate(options: argparse.Namespace, events: EventWriter, stop: StopSignal) -> None:
    """Answer with a lift's metrics.json, or with the same figures for the labels in two folders."""
    from ..job.report import metrics_text, read_metrics

    folders = (options.predictions, options.truth)
    if (options.lift is None) == (None in folders) or (options.lift is not None and any(folders)):
        raise PlgsError("evaluate-what", "give either LIFT, or --predictions and --truth", "evaluate", "See --help.")
    if options.lift is not None:
        lift = LiftFolder.open(options.lift)
        verify(lift.result_path)
        metrics: Mapping[str, Any] = _corrected_metrics(lift, events, stop) or read_metrics(lift)
    else:
        from ..metrics.report import score_folders, unscored
        from ..scene.label_folders import open_label_folder

        predicted = open_label_folder(options.predictions, is_truth=False)
        true = open_label_folder(options.truth, is_truth=True)
        metrics = score_folders(predicted, true, ids_per_frame=options.ids_per_frame)
        if left := unscored(predicted, true):
            events.warning(f"{left} frames with ground truth are not scored, as they have no prediction.")
    count = f"{len(metrics['test_frames'])} frames:\n" if options.lift is None else ""
    events.answer(metrics, count + metrics_text(metrics, per_class=options.classes))


def _corrected_metrics(lift: LiftFolder, events: EventWriter, stop: StopSignal) -> dict[str, object] | None:
    """The figures of a corrected lift, whose held-out frames are rendered again; None if nothing was corrected."""
    from ..corrections import CORRECTIONS, read_corrected

    if not (lift.path / CORRECTIONS).exists():
        return None
    corrected = read_corrected(lift.path)
    for line in corrected.warnings:
        events.warning(line)
    if corrected.removed:
        names = ", ".join(shortened(one.name, 60) for one in corrected.removed)
        events.warning(f"the ground truth still shows what was removed: {names}")
    if not corrected.fingerprint:
        return None
    from ..job.progress import StageProgress
    from ..lift.baking import score_corrected

    events.stage("evaluate", 1, 1, "Evaluating the corrected lift")
    return score_corrected(lift, corrected, StageProgress("evaluate", events, stop))


def inspect(options: argparse.Namespace, events: EventWriter, stop: StopSignal) -> None:
    from .inspect_scene import inspect_scene

    options.masks = filled_in(argparse.Namespace(scene=options.scene, masks=options.masks)).masks
    inspect_scene(source_of(options), events, stop, preset=options.preset, findings=options.output, fix=options.fix)


def classes(options: argparse.Namespace, events: EventWriter, stop: StopSignal) -> None:
    from ..scene.report import list_classes, write_class_list

    source = source_of(options)
    if options.write is not None:
        path = write_class_list(source, options.write)
        events.answer({"path": path}, f"Written: {path}")
        return
    listed = list_classes(source, options.table)
    lines = (f"{row.label:>6}  {row.name}{'' if row.into == row.name else f' -> {row.into}'}" for row in listed.rows)
    events.answer(to_json(listed), "\n".join([*lines, str(listed.path)]))


def find_scene(options: argparse.Namespace, events: EventWriter, stop: StopSignal) -> None:
    scene = _opened(options.lift, options.scene).request.scene
    events.answer({"scene": scene}, f"The lift now reads the scene {scene}")


def frames(options: argparse.Namespace, events: EventWriter, stop: StopSignal) -> None:
    from ..frames import make_frames
    from ..job.progress import StageProgress
    from ..scene import open_asked

    source = source_of(options)
    events.stage("frames", 1, 1, "Making frames")
    progress, output = StageProgress("frames", events, stop), options.output.resolve()
    scene = open_asked(source, progress.part(0.0, 0.1))
    try:
        made = make_frames(
            scene, source.resolved, output, kinds=options.make, names=options.frames, progress=progress.part(0.1, 1.0)
        )
    except OSError as error:
        fix = "Name a folder that you can write to, on a disk with free space."
        what = f"cannot be written ({error.strerror})"
        raise PlgsError("unwritable", what, error.filename or options.output, fix) from error
    answer = {"folder": made.folder, "frames": len(made.frames)}
    events.answer(answer, f"{len(made.frames)} frames in {made.folder}")


def poses(options: argparse.Namespace, events: EventWriter, stop: StopSignal) -> None:
    from ..poses import make_poses

    made = make_poses(options.scene, events, stop, options.pictures)
    unit = "" if made.scale is None else ", in metres by the depth beside them"
    text = f"Poses of {made.posed} of {made.photos} photos{unit}: {made.folder}"
    events.answer(asdict(made) | {"folder": str(made.folder)}, text)


def _scene_of(options: argparse.Namespace) -> Scene:
    """Open the scene of a command that changes only files beside it. Raises PlgsError if it cannot be read."""
    from ..scene import open_scene

    return open_scene(options.scene, up=options.up or "z", scene_format=options.scene_format)


def segment(options: argparse.Namespace, events: EventWriter, stop: StopSignal) -> None:
    """Make masks of a scene, or continue where an earlier run stopped."""
    from ..film import Wish, mask_scene, refuse_masks, scene_folder

    folder: Path = options.output or scene_folder(options.scene)
    wish = Wish(masks=options.model, download=options.download, merge=options.merge, frames=options.frames)
    if options.scene.exists():
        refuse_masks(folder, wish)
    scene = _scene_of(options)
    made = mask_scene(scene, folder, wish, events, stop)
    count = len(scene.frames) if made is None else made
    answer: dict[str, Json] = {"folder": str(folder), "frames": len(scene.frames), "masks": count}
    text = f"Masks of {count} of {len(scene.frames)} frames: {folder}"
    events.answer(answer, f"These masks are finished already: {folder}" if made is None else text)


def depth(options: argparse.Namespace, events: EventWriter, stop: StopSignal) -> None:
    """Make depth of a scene, or continue where an earlier run stopped."""
    from ..depth_making import is_made
    from ..film import Wish, depth_scene, scene_folder

    scene, folder = _scene_of(options), scene_folder(options.scene)
    if scene.has_depth and not is_made(folder):
        what = "this scene already has measured or given depth"
        raise PlgsError("has-depth", what, scene.folder, "Lift it as it is.")
    depth_scene(scene, folder, Wish(depth=options.model, download=options.download), events, stop)
    answer: dict[str, Json] = {"folder": str(folder), "frames": len(scene.frames)}
    events.answer(answer, f"Depth of {len(scene.frames)} frames: {folder}")


def prepare(options: argparse.Namespace, events: EventWriter, stop: StopSignal) -> None:
    from ..film import Wish, prepare

    wish = Wish(options.masks_model, options.depth_model, options.download, have=frozenset(options.have))
    folder = prepare(options.scene, wish, events, stop)
    events.answer({"folder": str(folder)}, f"Poses, depth and masks: {folder}")


def scale(options: argparse.Namespace, events: EventWriter, stop: StopSignal) -> None:
    from ..film import scene_folder
    from ..scene.made import set_scale

    scene = _scene_of(options)
    factor = set_scale(scene, scene_folder(options.scene), options.factor, options.measured)
    events.answer({"scale": factor}, f"Lengths of {options.scene} are multiplied by {factor:.6g}")


def handshake(options: argparse.Namespace, events: EventWriter, stop: StopSignal) -> None:
    from ..job.handshake import answer

    events.answer(answer().to_json())


def set_up(options: argparse.Namespace, events: EventWriter, stop: StopSignal) -> None:
    """Set up an environment. Packages come from PLGS_INDEX_URL, if set: a variable, as it may hold a password."""
    from ..set_up import SetUp, SetUpRequest, remove_environments

    if options.remove:
        remove_environments(options.folder)
        events.answer({}, f"No environment is left in {options.folder}")
        return
    sources = (os.environ.get("PLGS_INDEX_URL", ""), options.wheels, options.download, options.torch_hash)
    made = SetUp(SetUpRequest(options.base_python, options.torch, *sources), events, stop, folder=options.folder).run()
    if options.download is not None:
        events.answer({"wheels": made}, f"For set-up and add with --wheels: {made}")
        return
    events.answer({"python": made}, f"The engine's Python: {made}")


def add(options: argparse.Namespace, events: EventWriter, stop: StopSignal) -> None:
    """Add packages to this engine. They come from PLGS_INDEX_URL, if set."""
    from ..job.handshake import ALSO_ADDED
    from ..set_up import Addition

    index_url = os.environ.get("PLGS_INDEX_URL", "")
    folder = Addition(
        ALSO_ADDED.get(options.name, options.name), events, stop, index_url=index_url, wheels=options.wheels
    ).run()
    events.answer({"folder": folder}, f"Added to the engine: {options.name}")


def warm_up(options: argparse.Namespace, events: EventWriter, stop: StopSignal) -> None:
    from ..lift import warm_up

    warm_up()


def presets(options: argparse.Namespace) -> ExitCode:
    """Print the names of all presets or, as a file for --preset, one preset (a name or a file) with changed options.
    With --json, print the options' values in all presets, or in that one. Raises PlgsError for unknown names."""
    if options.name is not None or options.set:
        base, changed = chosen_options(options.name, parsed_options(options.set or ()))
        chosen = with_options(PRESETS[base], changed)
        values = {option: option_value(chosen, option) for option in preset_options()}
        print(json.dumps(values) + "\n" if options.json else preset_text(base, changed), end="")
    elif options.json:
        entries = []
        for name, option in preset_options().items():
            facts = {key: value for key, value in asdict(option).items() if value and value != math.inf}
            values = {base: option_value(preset, name) for base, preset in PRESETS.items()}
            entries.append({**facts, "values": values})
        print(json.dumps(entries, indent=1))
    else:
        for preset in PRESETS.values():
            width, height = preset.size
            text = f"{preset.last_step} steps, pictures within {width}x{height}, anchors every {preset.voxel_size} m"
            print(f"{preset.name:<9} {text}, objects by {preset.objects}, labels by {preset.labels}")
        print("\n'presets NAME' prints all options of one.")
    return ExitCode.FINISHED
