"""Make what a lift needs and a film or a folder of photos lacks: poses, depth and masks. Only what is missing is made,
beside the film. After an interruption, the same call continues the work."""

from __future__ import annotations

import shlex
import sys
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from .errors import ErrorCode, PlgsError
from .job import EventWriter, StopSignal
from .job.handshake import CAPABILITIES
from .job.prediction import MASK_S, machine_slowness
from .job.progress import StageProgress
from .known_networks import DEPTH, MASKS, known_network, licence_of, listing
from .poses import FILM_PICTURES, Made, encoded_depth, make_poses, refuse_unusable
from .scene import Scene, open_scene
from .scene.formats.photos import is_film, photos_in, sorted_out
from .scene.frame_choice import frames_to_mask
from .scene.masks import MASK_FOLDER

_POSE_S = 0.4  # processor seconds of COLMAP per photo; 72 photos took 22
_MINUTE = 60.0


@dataclass(frozen=True)
class Wish:
    """What `prepare` makes. ``masks`` and ``depth`` each name a network: a folder, or a name on the Hugging Face hub,
    from which it is fetched only with ``download``. ``merge`` is a name of ``segment.MERGES``, ``frames`` says which
    frames get masks ("all" or "auto"), and ``have`` lists what the user has already, which is not made."""

    masks: str = MASKS[0].name
    depth: str = DEPTH[0].name
    download: bool = False
    merge: str = "one"
    frames: str = "all"
    have: frozenset[str] = frozenset()


def scene_folder(source: Path) -> Path:
    """The folder for files that are made for a scene: the scene's own, or for a film its path without the suffix."""
    return source if source.is_dir() else source.with_suffix("")


def prepare(source: Path, wish: Wish, events: EventWriter, stop: StopSignal) -> Path:
    """Make what ``source``, a film or a folder of photos, lacks: poses and, as wished, depth and masks. Returns the
    scene's folder. Raises PlgsError, before any work if packages or networks are missing; OSError; Cancelled."""
    folder = scene_folder(source)
    if Made.read(folder) is None:
        refuse_unusable(source)
    _refuse_missing(source, folder, wish, events)
    if Made.read(folder) is None:
        photos = photos_in(source) if source.is_dir() else None
        count = FILM_PICTURES if photos is None else len(sorted_out(photos)[0])
        events.stage("plan", 1, 1, f"Finding poses of up to {count} pictures, in {_about(count * _POSE_S)}")
    make_poses(source, events, stop)
    missing = _missing(source, folder, wish)
    if "depth" in missing:
        depth_scene(open_scene(folder), folder, wish, events, stop)
    if "masks" in missing:
        mask_scene(open_scene(folder), folder, wish, events, stop)
    return folder


def _refuse_missing(source: Path, folder: Path, wish: Wish, events: EventWriter) -> None:
    """Warn of networks that will be downloaded. Raises one PlgsError that lists all missing packages, and all networks
    that are not on this computer and may not be downloaded."""
    from .networks import is_here

    missing = _missing(source, folder, wish)
    parts = [*([] if Made.read(folder) is not None else ["colmap"]), *(["segment"] if missing else [])]
    lacking = [part for part in parts if any(find_spec(each) is None for each in CAPABILITIES[part].packages.values())]
    packages = [f"packages for {CAPABILITIES[part].label}: {CAPABILITIES[part].size / 1e6:.0f} MB" for part in lacking]
    networks = listing(name for each in missing if not is_here(name := getattr(wish, each))).splitlines()
    if lacking or (networks and not wish.download):
        what = f"this must be downloaded first: {'; '.join([*packages, *networks])}"
        agree = ["--download"] if networks and not wish.download else []
        add = f"{shlex.quote(sys.executable)} -m engine add"
        fix = " ".join([*(f"Add to the engine: {add} {part}." for part in lacking),
                        *(f"Give {option} if you agree to the licences." for option in agree)])  # fmt: skip
        if lacking:
            raise PlgsError("lacks-parts", what, source, fix, code=ErrorCode.LACKS_PART, option=lacking[0])
        raise PlgsError("downloads", what, source, fix, option="--download")
    for line in networks:
        events.warning(f"Downloading now: {line}")


def _missing(source: Path, folder: Path, wish: Wish) -> list[str]:
    """Return which of "depth" and "masks" must still be made by ``wish``, as far as is known before poses exist."""
    from .segment import TABLE

    if Made.read(folder) is not None:
        scene = open_scene(folder)
        has = {"depth": scene.has_depth, "masks": scene.has_masks}
    else:
        measured = (folder / "depth").is_dir() or (is_film(source) and encoded_depth(source) is not None)
        has = {"depth": measured, "masks": (folder / TABLE).is_file() or (folder / MASK_FOLDER).is_dir()}
    return [what for what, is_there in has.items() if not is_there and what not in wish.have]


def _about(seconds: float) -> str:
    return f"about {max(1, round(seconds * machine_slowness() / _MINUTE))} min"


def say_terms(name: str, events: EventWriter) -> None:
    """Before a network is downloaded, warn of a licence that forbids commercial use or is not known."""
    about = licence_of(name)
    if about["commercial_use"] is not True:
        said = str(about["licence"])
        events.warning(f"{said[0].upper()}{said[1:]}")


def depth_scene(scene: Scene, folder: Path, wish: Wish, events: EventWriter, stop: StopSignal) -> None:
    """Make a scene's depth maps in ``folder`` with the network ``wish.depth``, or continue an earlier run. Raises
    PlgsError if the network cannot be loaded or does not fit the scene; OSError; Cancelled."""
    from .depth_making import load_depth_network, make_depth

    name = _resolved(wish.depth)
    say_terms(name, events)
    events.stage("load", 1, 2, "Loading the network for depth")
    network = load_depth_network(name, download=wish.download)
    stop.check()
    seconds = len(scene.frames) * (known_network(name) or DEPTH[0]).seconds
    told = f"Making depth of {len(scene.frames)} frames, in {_about(seconds)}"
    events.stage("depth", 2, 2, told)
    for warning in make_depth(scene, folder, network, StageProgress("depth", events, stop)):
        events.warning(warning)


def refuse_masks(folder: Path, wish: Wish) -> None:
    """Raise PlgsError, before a scene is opened, if `mask_scene` has no network for masks in ``folder``, or others are
    there."""
    from .networks import refuse_missing
    from .segment import masks_in, refuse_others

    refuse_others(folder)
    if not masks_in(folder):  # finished ones need no network
        refuse_missing(_resolved(wish.masks), "masks are made", download=wish.download)


def mask_scene(scene: Scene, folder: Path, wish: Wish, events: EventWriter, stop: StopSignal) -> int | None:
    """Make a scene's masks in ``folder`` with the network ``wish.masks``, or continue an earlier run. Returns how many
    frames have them, or None if all had them before. Raises PlgsError for a bad network or other masks."""
    from .mask_networks import load_model
    from .segment import MERGES, begin_job, make_masks

    name, wanted = _resolved(wish.masks), None
    if wish.frames == "auto":
        events.stage("choose", 1, 3, "Choosing frames")
        chosen = frames_to_mask(scene, StageProgress("choose", events, stop))
        wanted = frozenset(frame.name for frame in chosen)
    count = len(scene.frames) if wanted is None else len(wanted)
    job = begin_job(folder, name, scene.frames, wanted)
    if job.is_finished:
        return None
    say_terms(name, events)
    events.stage("load", 2, 3, "Loading the network for masks")
    try:
        network = load_model(name, download=wish.download, rounds=MERGES[wish.merge])
    except PlgsError:
        job.discard_if_empty()
        raise
    stop.check()
    told = f"Making masks of {count} of {len(scene.frames)} frames, in {_about(count * MASK_S)}"
    events.stage("segment", 3, 3, told)
    progress = StageProgress("segment", events, stop)

    def follow(done: int, frames: int, made: int) -> None:
        stop.check()
        if made:  # masks kept from an earlier run took no time, and would spoil the estimate
            progress(done, frames)

    try:
        make_masks(scene, job, network, follow, wanted)
    except OSError as error:
        fix = "Make room, or let PLGS write there, then continue."
        what = f"masks cannot be written ({error.strerror})"
        raise PlgsError("unwritable", what, job.folder, fix, code=ErrorCode.DISK_FULL) from error
    return count


def _resolved(model: str) -> str:
    return str(Path(model).resolve()) if Path(model).is_dir() else model
