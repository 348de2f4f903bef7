"""Bakes (renders to EXR passes) further views of a finished lift: its own frames, bit for bit as the lift writes them,
and views from any camera. Several processes may bake the same lift at once; each view is then baked by only one. The
passes become part of the lift's result, or go into another folder, where no manifest lists them."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..corrections import CorrectedResult, read_corrected
from ..errors import PlgsError
from ..job import BakeCamera, BakeLocks, EventWriter, LiftFolder, StopSignal, read_cameras
from ..job.cameras import PreviewCamera, frame_numbers, refuse_equal_names
from ..job.events import at_work
from ..job.manifest import add_files, drop_files, lifted_digest, read_manifest
from ..job.own_files import foreign
from ..job.progress import StageReporter
from ..model.neural_gaussians import ClipRange
from ..passes.baked_view import BakedView
from ..passes.exr import ShownFrame, further_layers, is_cut, is_frame, is_own, number_in, read_note, write_exr
from ..posed.layout import listed, plural
from ..scene import Camera, Frame, Scene, size_within
from ..scene_of_lift import complete_known_scene, names_of_frames, scene_of_lift
from .baking import CORRECTIONS_NOTE, FrameBaker, baked_files, names_of_files, read_baker
from .device import be_repeatable
from .frame_sets import check_disk
from .judging import Unresolved, report_unresolved, unresolved

STAGES = {"open": "Opening the lifted scene", "bake": "Baking panoptic passes"}
KEEP_EVERY_S = 20.0
"""Seconds between two additions of baked views to the manifest: the most work that is lost if a process is killed."""
WAIT_S = 0.2
"""Seconds between two checks of the views that other processes are baking."""
CAMERA_NOTE = "plgs/camera"
"""Attribute in the header of a view that does not belong to a frame: the fingerprint of its camera."""
LIFT_NOTE = "plgs/lift"
"""Header attribute with the name of the lift's folder."""
MOTION_NOTE = "plgs/motion"
"""Header attribute of a view with the layer Vector: the fingerprint of the cameras before and after it."""
CHANNELS_NOTE = "plgs/channels"
"""Attribute in the header of a view whose channels are not named for Blender: the program that they are named for."""
MODEL_NOTE = "plgs/model"
"""Header attribute of a view of no frame, or in a folder of its own: the SHA-256 of the lift's model and objects."""
_SHOWS = {
    MODEL_NOTE: "another lift result", CORRECTIONS_NOTE: "other corrections", CAMERA_NOTE: "another camera",
    CHANNELS_NOTE: "other channel names",
}  # fmt: skip
"""By header note, the words for what an earlier file shows if this note differs."""
MOST_LOOKS, LOOK_WITHIN = 8, (96, 96)
"""How many views are rendered before a bake, and in which size, to estimate what the photos do not resolve."""


@dataclass(frozen=True)
class BakeOptions:
    """What a bake writes, and where. ``layers``: names from FURTHER_LAYERS to write besides the usual ones. ``output``:
    the folder for the passes (None: the lift's result); other programs' files there are overwritten only with
    ``replace``. ``channels``: one of CHANNELS; for the result always "blender". ``corrected``: what to show, by default
    the lift with its corrections."""

    layers: tuple[str, ...] = ()
    output: Path | None = None
    channels: str = "blender"
    replace: bool = False
    corrected: CorrectedResult | None = None


@dataclass(frozen=True, eq=False)
class WantedView:
    """A view to bake. ``name``: what its files are called. ``fingerprint``: identifies its camera; "" if the view is a
    frame of the capture, called ``frame``. ``shown``: frame number and rate for the EXR header. ``previous``,
    ``following``: cameras of the frames before and after, for the layer Vector; ``motion``: identifies both."""

    name: str
    camera: Camera
    clip: ClipRange = ClipRange()
    fingerprint: str = ""
    shown: ShownFrame = ShownFrame()
    frame: str = ""
    previous: Camera | None = None
    following: Camera | None = None
    motion: str = ""


def bake_frames(
    folder: LiftFolder,
    frames: Sequence[str],
    events: EventWriter,
    stop: StopSignal,
    options: BakeOptions = BakeOptions(),
) -> str:
    """Bake the ``frames`` ("test", "all", names or ranges) that are not baked yet; return a sentence on it for the
    user. A bake that is stopped keeps its finished views. Raises PlgsError if the scene can no longer be read or lacks
    a frame, and Cancelled if stopped."""

    def views_in(scene: Scene) -> list[WantedView]:
        lost = {*names_of_frames(folder)} - {frame.name for frame in scene.frames}
        if lost and {"all", "test"}.intersection(frames):
            events.warning(f"the scene no longer has frame {listed(sorted(lost))}, which is not baked")
        names, cameras = names_of_files(folder), [None, *(frame.camera for frame in scene.frames), None]
        beside = {frame.name: (cameras[k], cameras[k + 2]) for k, frame in enumerate(scene.frames)}
        return [
            WantedView(
                names.get(frame.name, frame.name), frame.camera, frame=frame.name,
                previous=beside[frame.name][0], following=beside[frame.name][1],
            )
            for frame in frames_named(scene, frames)
        ]  # fmt: skip

    with BakeLocks(folder.path) as locks:
        return _bake(folder, locks, views_in, events=events, stop=stop, options=options)


def bake_cameras(
    folder: LiftFolder, cameras: Path, events: EventWriter, stop: StopSignal, options: BakeOptions = BakeOptions()
) -> str:
    """Bake the views in the file ``cameras`` (see `job.cameras`) that are not baked yet; return a sentence on it for
    the user. A view that was baked earlier from another camera of the same name is baked again. Raises PlgsError for a
    bad camera, one with the name of a frame, or a scene that is gone; Cancelled."""

    def views_in(scene: Scene) -> list[WantedView]:
        wanted = read_cameras(cameras)
        taken = [*(frame.name for frame in scene.frames), *names_of_files(folder).values()]
        refuse_equal_names([camera.name for camera in wanted], cameras, taken)
        return [view_from(camera) for camera in wanted]

    with BakeLocks(folder.path) as locks:
        return _bake(folder, locks, views_in, events=events, stop=stop, options=options)


def view_from(camera: BakeCamera) -> WantedView:
    """Convert a camera as read from a file of cameras to a view that can be baked."""
    shown, clip = ShownFrame(camera.frame, camera.fps, camera.display), ClipRange(camera.near, camera.far)
    previous, following = (None if each is None else _camera_of(each) for each in (camera.previous, camera.next))
    seen = _camera_of(camera.pinhole)
    return WantedView(camera.name, seen, clip, camera.fingerprint, shown, "", previous, following, camera.motion)


def _camera_of(pinhole: PreviewCamera) -> Camera:
    (fx, _, cx), (_, fy, cy), _ = pinhole.K
    pose = np.array(pinhole.camera_to_world)
    return Camera(pinhole.width, pinhole.height, fx, fy, cx, cy, pose, pinhole.projection)


def _bake(
    folder: LiftFolder, locks: BakeLocks, views_in: Callable[[Scene], list[WantedView]], *, events: EventWriter,
    stop: StopSignal, options: BakeOptions,
) -> str:  # fmt: skip
    if folder.is_lifted_again and events.path != folder.events_path and folder.is_running:
        raise at_work(folder.events_path)  # its new result will take the place of this one
    be_repeatable()
    stages = StageReporter(events, stop, STAGES)
    with stages.stage("open"):
        scene = scene_of_lift(folder)
        corrected = options.corrected or read_corrected(folder.path)
        for line in corrected.warnings:
            events.warning(line)
        notes = {CORRECTIONS_NOTE: corrected.fingerprint}
        destination = _Result(folder, locks, options) if options.output is None else _OwnFolder(folder, options)
        if options.output is None:
            complete_known_scene(folder, scene)
        asked, began = views_in(scene), time.monotonic()
        wanted = [view for view in asked if not destination.has(view, notes)]
        again = [view.name for view in wanted if destination.path_of(view).exists()]
        if again:
            events.warning(f"views are baked again, with other layers or in another state: {listed(again)}")
        check_disk(options.output or folder.path, (view.camera.size for view in wanted), events)
        baker = read_baker(folder, scene.classes, corrected)
        photos, found = [frame.camera for frame in scene.train_frames], list[tuple[str, Unresolved]]()
        look_ahead(baker, wanted, photos, events)
    with stages.stage("bake") as progress:
        left = wanted
        try:
            while left:
                others = list[WantedView]()
                for number, view in enumerate(left, start=1):
                    with locks.claim(destination.claim_of(view)) as is_ours:
                        if not is_ours:
                            others.append(view)
                        elif not destination.has(view, notes):
                            rendered = baker.render(view.camera, view.clip)
                            rendered = replace(rendered, previous=view.previous, following=view.following)
                            if view.fingerprint:
                                found.append((view.name, unresolved(rendered.layers, view.camera, photos)))
                            destination.write(view, rendered, baker, events)
                    progress(len(wanted) - len(left) + number - len(others), len(wanted))
                destination.keep()
                # Only views on disk count as done: a process that is baking one of these may still be killed.
                time.sleep(WAIT_S if others else 0.0)
                left = others
        finally:
            destination.keep()
            report_unresolved(found, events, before=False)
    there = f"; {len(asked) - len(wanted)} were baked before" if len(asked) > len(wanted) else ""
    place = options.output or folder.passes_path
    return f"Baked {plural(len(wanted), 'view')} in {time.monotonic() - began:.0f} s{there}: {place}"


def look_ahead(baker: FrameBaker, wanted: Sequence[WantedView], photos: Sequence[Camera], events: EventWriter) -> None:
    """Before a bake, warn if the ``photos`` resolve too little of the ``wanted`` views, by a few small renderings."""
    free, found = [view for view in wanted if view.fingerprint], []
    for view in free[:: -(-len(free) // MOST_LOOKS) or 1]:
        small = view.camera.resized(*size_within(view.camera.size, LOOK_WITHIN))
        layers = baker.render(small, view.clip).layers
        found.append((view.name, unresolved(layers, small, photos, view.camera.width / small.width)))
    report_unresolved(found, events, before=True)


def is_whole(passes: Path, notes: Mapping[str, str], layers: tuple[str, ...], shown: ShownFrame) -> bool:
    """Whether the EXR file ``passes`` is undamaged and has the ``notes`` in its header (a missing note counts as ""),
    the frame number and rate of ``shown``, and at least the ``layers`` (from FURTHER_LAYERS). Raises OSError."""
    try:
        same = all((read_note(passes, name) or "") == text for name, text in notes.items())
        same = same and not is_cut(passes)
        return same and is_frame(passes, shown) and further_layers(passes).issuperset(layers)
    except (ValueError, PlgsError):
        return False


def frames_named(scene: Scene, names: Sequence[str]) -> list[Frame]:
    """Return the frames that ``names`` select, in recording order, each once: by their own name, by "all", by "test"
    (the held-out frames, and a frame of that name), or by a range such as "10-200:2" (see `frame_numbers`) of the last
    number in their names (10 for frame_0010.colour). Raises PlgsError for a name or a range that matches no frame."""
    groups: dict[str, tuple[Frame, ...]] = {frame.name: (frame,) for frame in scene.frames}
    for name, group in (("all", scene.frames), ("test", scene.test_frames)):
        groups[name] = group + groups.get(name, ())
    wanted = set[str]()
    for name in names:
        found: Sequence[Frame] = groups.get(name, ())
        if name not in groups:
            with suppress(ValueError):  # for a text that is no range
                ranges = frame_numbers(name)  # in thousandths
                numbers = [(frame, number_in(frame.name)) for frame in scene.frames]
                found = [frame for frame, n in numbers if n is not None and any(1000 * n in each for each in ranges)]
        if not found and name not in groups:
            fix = f"Give all, test, names of frames, such as {scene.frames[0].name}, or numbers: 10-200:2 or 7,9."
            raise PlgsError("no-frame", f"the scene has no frame {name}", scene.folder, fix)
        wanted.update(frame.name for frame in found)
    return [frame for frame in scene.frames if frame.name in wanted]


def _notes_of(view: WantedView, layers: Collection[str]) -> dict[str, str]:
    notes = {CAMERA_NOTE: view.fingerprint} if view.fingerprint else {}
    return notes | {MOTION_NOTE: view.motion} if view.motion and "vector" in layers else notes


class _OwnFolder:
    """Where a bake goes if the user chose a folder outside the lift's result."""

    def __init__(self, folder: LiftFolder, options: BakeOptions) -> None:
        assert options.output is not None
        self._output, self._layers, self._lift = options.output, options.layers, folder.path.name
        self._channels, self._replace = options.channels, options.replace
        if self._output.resolve().is_relative_to(folder.result_path.resolve()):
            raise PlgsError("inside", "is within the lift's result", self._output, "Name another folder.", option="-o")
        named = {CHANNELS_NOTE: "" if options.channels == "blender" else options.channels}
        self._model = {MODEL_NOTE: lifted_digest(read_manifest(folder.result_path))} | named

    def claim_of(self, view: WantedView) -> str:
        """Return the name of the lock that keeps other processes from baking this view at the same time."""
        return str(self.path_of(view).resolve())

    def path_of(self, view: WantedView) -> Path:
        return self._output / f"{view.name}.exr"

    def has(self, view: WantedView, notes: Mapping[str, str]) -> bool:
        """Whether the folder already has this view, from the same camera and model, with these header notes. Raises
        OSError and, unless files may be replaced, PlgsError if the view's file comes from another program, or shows
        another camera or model."""
        path = self.path_of(view)
        if not os.path.lexists(path):
            return False
        if not (is_own(path) and read_note(path, MODEL_NOTE)):
            if self._replace:
                return False
            raise foreign(path, "Give another folder, or add --replace to overwrite it.", "--replace")
        if is_whole(path, {**notes, **_notes_of(view, self._layers), **self._model}, self._layers, view.shown):
            return True
        if (other := self._other(view, notes)) and not self._replace:
            fix = "Give another folder or, with --shot, a name with {version}, or add --replace to overwrite it."
            raise PlgsError("other-state", f"was baked with {other}", path, fix, option="--replace")
        return False

    def _other(self, view: WantedView, notes: Mapping[str, str]) -> str:
        """Return how an earlier file of the view differs in what it shows; "" if it differs only in layers."""
        path = self.path_of(view)
        wanted = {**self._model, **notes, CAMERA_NOTE: view.fingerprint}
        differing = [name for name, text in wanted.items() if (read_note(path, name) or "") != text]
        has_motion = read_note(path, MOTION_NOTE) not in (None, view.motion)
        other = [_SHOWS[name] for name in differing] + ["other cameras in the frames beside it"] * has_motion
        return " and ".join(other) or ("" if is_frame(path, view.shown) else "another frame number or frame rate")

    def write(self, view: WantedView, rendered: BakedView, baker: FrameBaker, events: EventWriter) -> None:
        """Write the passes of a view, as ``baker`` ``rendered`` it. Raises OSError."""
        self._output.mkdir(parents=True, exist_ok=True)
        path, layers = self.path_of(view), {*self._layers}
        if path.exists() and is_own(path) and not self._other(view, {CORRECTIONS_NOTE: ""} | baker.notes):
            layers |= further_layers(path) - (set() if view.previous or view.following else {"vector"})
        notes = {**_notes_of(view, layers), **self._model, **baker.notes, LIFT_NOTE: self._lift}
        notes = {name: text for name, text in notes.items() if text}
        write_exr(path, rendered, notes=notes, layers=layers, shown=view.shown, named_for=self._channels)

    def keep(self) -> None:
        """Do nothing: a folder outside the result has no manifest to update."""


class _Result:
    """Where a bake goes by default: the lift's result. Every KEEP_EVERY_S seconds its manifest is updated."""

    def __init__(self, folder: LiftFolder, locks: BakeLocks, options: BakeOptions) -> None:
        self._folder, self._locks, self._layers = folder, locks, options.layers
        self._of_lift = {MODEL_NOTE: lifted_digest(read_manifest(folder.result_path)), LIFT_NOTE: folder.path.name}
        self._views, self._kept_at = list[WantedView](), time.monotonic()
        self._read: tuple[tuple[int, int, int], frozenset[Path]] | None = None

    def claim_of(self, view: WantedView) -> str:
        return view.name

    def path_of(self, view: WantedView) -> Path:
        return baked_files(self._folder, view.name)[0]

    def has(self, view: WantedView, notes: Mapping[str, str]) -> bool:
        """Whether the result has this view, from its camera and with these header notes. Raises PlgsError, OSError."""
        files, wanted = baked_files(self._folder, view.name), {**notes, **_notes_of(view, self._layers)}
        return self._listed().issuperset(files) and is_whole(files[0], wanted, self._layers, view.shown)

    def write(self, view: WantedView, rendered: BakedView, baker: FrameBaker, events: EventWriter) -> None:
        """Write the view, replacing an older file. Raises PlgsError if another program wrote that file, and OSError."""
        files = baked_files(self._folder, view.name)
        for path in files:  # a killed bake's are not listed; without passes, previews are not of a bake
            if os.path.lexists(path) and path not in self._listed() and not (files[0].exists() and is_own(files[0])):
                raise foreign(path)
        if old := self._listed().intersection(files):
            with self._locks.manifest():  # the result is complete without the view that is baked again
                drop_files(self._folder.result_path, sorted(old))
        notes = _notes_of(view, self._layers) | (self._of_lift if view.fingerprint else {})
        baker.write(
            self._folder, view.name, rendered, events, notes=notes, layers=self._layers, shown=view.shown
        )  # fmt: skip
        self._views.append(view)
        if self._locks.others_at_work() or time.monotonic() - self._kept_at > KEEP_EVERY_S:
            self.keep()  # before another process looks for views that are left to bake

    def _listed(self) -> frozenset[Path]:
        """Return the manifest's files. They are cached, as reading a manifest of thousands takes part of a second."""
        result = self._folder.result_path
        if not self._folder.manifest_path.is_file():
            read_manifest(result)  # which says what is wrong
        state = self._folder.manifest_path.stat()
        version = (state.st_ino, state.st_mtime_ns, state.st_size)
        if self._read is None or self._read[0] != version:
            self._read = version, frozenset(result / file.path for file in read_manifest(result).files)
        return self._read[1]

    def keep(self) -> None:
        """Add the views baked since the last call to the manifest. Raises OSError."""
        files = [path for view in self._views for path in baked_files(self._folder, view.name)]
        if files:
            with self._locks.manifest():
                own = {view.name: view.frame for view in self._views if view.frame not in ("", view.name)}
                add_files(self._folder.result_path, files, own)
        self._views, self._kept_at = [], time.monotonic()
