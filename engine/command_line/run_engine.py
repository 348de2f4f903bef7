"""Run the engine in a lift folder, from the lock to the exit code: a lift, or baking more passes."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Sequence
from pathlib import Path

from ..errors import ErrorCode, ExitCode, PlgsError
from ..job import EventWriter, LiftFolder, LiftState, StopSignal, verify_lifted
from ..job.recent import remember_lift
from ..job.studio import studio_defaults
from ..job.system import SHARE
from ..job.task import BAKE, LIFT, TaskFiles
from .runner import Command, Work, output_to, run_at, run_task

log = logging.getLogger("plgs.engine")


def run_engine(
    folder: LiftFolder,
    *,
    resume: bool = False,
    parent_pipe: int | None = None,
    lift: Callable[..., None] | None = None,
    echo: int | None = None,
) -> ExitCode:
    """Lift, and return how it ended. It stops when the pipe ``parent_pipe`` (a descriptor) ends. ``lift`` is called
    instead of `run_lift`. Events are also written to the descriptor ``echo``. Raises PlgsError, before anything is
    changed, if another engine is at work, or if the folder was used and ``resume`` is not given. Later errors become an
    event, a line on standard error and an exit code."""
    folder.refuse_foreign()
    folder.refuse_read_only()
    with folder.lock():
        if not (folder.path / "request.json").exists():
            raise PlgsError("lift-removed", "was removed in the meantime", folder.path, "Lift the scene again.")
        if resume:  # otherwise the command is refused, and must change nothing
            folder.adopt_next_result()
        state = folder.state_at_rest()
        if resume:
            from ..scene_of_lift import is_done  # late: it needs numpy

            if is_done(folder):
                folder.drop_next_result()  # it would lift the same masks again
                print(f"This lift is finished already: {folder.result_path}")
                return ExitCode.FINISHED
        elif state is not LiftState.NOT_STARTED:
            is_whole = state is LiftState.FINISHED
            fix = "Choose another folder." if is_whole else "Add --resume to continue it."
            what = f"holds a lift that was begun before ({state.value})"
            raise PlgsError("lift-begun", what, folder.path, fix, option="" if is_whole else "--resume")
        with output_to(folder.log_path) as terminal:
            if resume:
                folder.prepare_run()

            def work(events: EventWriter, stop: StopSignal) -> None:
                studio = studio_defaults()
                if studio.file is not None:
                    log.info("defaults of %s: %s", studio.file, studio)
                if studio.memory is not None:
                    os.environ.setdefault(SHARE, f"{studio.memory:g}")  # a batch's own setting takes precedence
                if lift is not None:
                    return lift(folder, events, stop, resume=resume)
                if state is LiftState.NOT_STARTED:  # refused at once, not only after torch was loaded
                    from ..scene.formats import find_format

                    find_format(folder.request.scene, folder.request.scene_format)
                from ..lift import run_lift  # late: it loads torch, and by now the watchdog can stop a slow import
                from ..plates import make_fills

                run_lift(folder, events, stop, resume=resume, make_fills=make_fills)

            command = Command(
                LIFT,
                lambda events, stop: _do_in(folder, events, stop, work),
                resumed=resume and folder.checkpoints.exists,
                when_stopped=f"Give the same command with --resume to continue: {folder.path}",
                again="resume",
                with_less_memory="Resume after closing other programs, or lift again with a smaller --size.",
                parent_pipe=parent_pipe,
                echo=echo,
            )
            return run_at(command, folder.task_files, terminal)


def run_bake(
    folder: LiftFolder,
    frames: Sequence[str] | None,
    *,
    cameras: Path | None = None,
    layers: Sequence[str] = (),
    output: Path | None = None,
    channels: str = "blender",
    replace: bool = False,
    without: Sequence[str] = (),
    parent_pipe: int | None = None,
    files: TaskFiles | None = None,
    echo: int | None = None,
) -> ExitCode:
    """Bake more of a finished lift, frames ("test", "all", or their names) or the cameras in a file, and return how it
    ended. ``layers`` are written besides the usual ones, into ``output`` (None: the result), with the names of
    ``channels``; ``replace`` overwrites others' files there. The objects ``without`` are not shown, as if they had been
    removed. Whatever happens, the lift stays finished and earlier passes are kept. If another process is baking
    already, both bake at the same time: this one has its events in ``files`` or, if no program follows it (no
    ``parent_pipe``), in its own folder below bake/. The lift's file 'cancel' stops all bakes. If no program follows it,
    standard output says what was baked. Events also go to the descriptor ``echo``."""
    baked = list[str]()

    def work(events: EventWriter, stop: StopSignal) -> None:
        from ..lift import BakeOptions, bake_cameras, bake_frames  # late: it loads torch

        corrected = None
        if without:
            from ..job.progress import StageProgress
            from ..plates import without as without_objects

            events.stage("remove", 1, 3, "Removing objects")
            progress = StageProgress("remove", events, stop)
            corrected = without_objects(folder, without, progress, events.warning)
        options = BakeOptions(tuple(layers), output, channels, replace, corrected)
        if cameras is not None:
            baked.append(bake_cameras(folder, cameras, events, stop, options))
        if frames is not None:
            baked.append(bake_frames(folder, frames, events, stop, options))

    command = Command(
        BAKE,
        lambda events, stop: _do_in(folder, events, stop, work),
        when_stopped=f"The result is complete, with what was baked so far: {folder.path}",
        again="bake again",
        with_less_memory="Bake again after closing other programs.",
        parent_pipe=parent_pipe,
        echo=echo,
        also_stops=(folder.task_files.cancel,),
    )
    folder.refuse_foreign()
    folder.refuse_read_only()  # also for a bake elsewhere: events and claims of views are in the lift
    if files is not None:
        _refuse_unfinished(folder)
        return run_task(command, files)
    try:
        lock = folder.lock().__enter__()  # not `with`: an error of the work must not count as busy
    except PlgsError as error:
        if error.code is not ErrorCode.BUSY:
            raise
        if parent_pipe is not None or folder.state_at_rest() is not LiftState.FINISHED:
            raise
        (folder.path / "bake").mkdir(exist_ok=True)
        beside = TaskFiles.temporary(folder.path / "bake")
        code = run_task(command, beside)
        if code is ExitCode.FINISHED:
            beside.discard()
            print(*baked, sep="\n")
        return code
    try:
        _refuse_unfinished(folder)
        with output_to(folder.log_path) as terminal:
            folder.prepare_bake()
            code = run_at(command, folder.task_files, terminal)
        if baked and parent_pipe is None and echo is None:
            print(*baked, sep="\n")
        return code
    finally:
        lock.__exit__(None, None, None)


def _do_in(folder: LiftFolder, events: EventWriter, stop: StopSignal, work: Work) -> None:
    """Do the work, and put the lift in the list of recent lifts when it begins and when it ends."""
    _remember(folder)
    try:
        work(events, stop)
        if not folder.has_result():
            if folder.manifest_path.is_file():
                verify_lifted(folder.result_path)  # somebody removed files of it in the meantime
            raise RuntimeError("the lift ended without a manifest")  # a bug, which `failure_of` reports as one
    finally:
        _remember(folder)


def _remember(folder: LiftFolder) -> None:
    try:
        remember_lift(folder.path)
    except (OSError, PlgsError) as error:  # the lift matters more
        log.warning("this lift is not in the list of recent ones: %s", error)


def _refuse_unfinished(folder: LiftFolder) -> None:
    """Raise PlgsError for a lift that is not finished, or that was finished and is damaged."""
    if not folder.manifest_path.is_file():
        what = f"this lift is not finished ({folder.state_at_rest().value})"
        raise PlgsError("not-finished", what, folder.path, "Resume it first.", code=ErrorCode.NOT_FINISHED)
    verify_lifted(folder.result_path)
