"""Open the scene of a lift at its requested path. If it was moved, only its cameras are available."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from .errors import ErrorCode, PlgsError
from .job import LiftFolder, read_manifest, write_atomically
from .job.progress import Progress, part_of, unwatched
from .known_scene import FIND_SCENE, KNOWN_SCENE, StoredScene, known_scene, read_known, stored_scene, write_known
from .result_files import INSTANCES, read_instances
from .scene import EvidenceReader, Frame, MaskReader, PosedFrame, Scene, digests_of_files, open_asked, watched

_ALIKE = 1e-4  # tolerance in metres, pixels and entries of rotations when cameras of the same frame are compared
_ANOTHER = "Restore it as it was, say where it is with Find Scene or --scene, or lift into another folder."


def scene_of_lift(folder: LiftFolder) -> Scene:
    """Return the scene that a lift was made from, with the classes of the result. If the scene is gone, return frames
    that have cameras, and whose readers of pixels raise PlgsError. Raises PlgsError for a scene that is unreadable,
    replaced by another, or gone without a record."""
    if os.path.exists(folder.request.scene) or not (folder.path / KNOWN_SCENE).is_file():
        scene = opened_scene(folder)
        result = folder.result_path / INSTANCES
        return replace(scene, classes=read_instances(result)[0]) if result.is_file() else scene
    known, gone = known_scene(folder), _gone(folder.request.scene)
    frames = tuple(
        Frame(each.name, each.camera, each.held_out, each.colour_path, None, gone, gone, gone, file_shows_colour=False)
        for each in known.frames
    )
    return Scene(known.folder, frames, known.classes, known.warnings)


def opened_scene(folder: LiftFolder) -> Scene:
    """Open a lift's scene as its files are now. Raises PlgsError for bad files, other cameras, or if most are gone."""
    scene, known = open_asked(folder.request), read_known(folder)
    if known is not None:
        _refuse_another(known, scene)
    return scene


def _refuse_another(known: StoredScene, scene: Scene) -> None:
    """Raise PlgsError if a camera differs, or if most known frames are gone; a few may be missing."""
    there = {frame.name for frame in scene.frames}
    kept = [frame for frame in known.frames if frame.name in there]
    compared = kept if 2 * len(kept) >= len(known.frames) else known.frames
    refuse_others([frame.posed(scene.folder) for frame in compared], scene)


def names_of_frames(folder: LiftFolder) -> tuple[str, ...]:
    """Return the names of all frames of a lift's scene; () if unknown. Raises PlgsError for a damaged scene.json."""
    known = read_known(folder)
    return () if known is None else tuple(frame.name for frame in known.frames)


def remember_scene(
    folder: LiftFolder, scene: Scene, warn: Callable[[str], object] = lambda _: None, progress: Progress = unwatched
) -> str:
    """Write the cameras and the digests of the files of a lift's scene beside its request. Returns the masks' digest.
    An unfinished result whose passes show other masks or classes is moved, with a warning. Raises PlgsError."""
    masks = digest_of_masks(scene, part_of(progress, 0.0, 0.5))
    are_others = masks_differ(masks_last_run(folder), scene, masks) or have_classes_changed(folder, scene)
    if are_others and not folder.is_lifted_again and any(folder.passes_path.glob("*.exr")):
        warn_of_earlier(folder.set_result_aside(), warn)
    known, files = stored_scene(scene, scene.frames, masks), _digests_of(scene.frames, part_of(progress, 0.5, 1.0))
    frames = tuple(replace(one, files=found, read=how) for one, (found, how) in zip(known.frames, files, strict=True))
    write_known(folder, replace(known, frames=frames))
    return masks


def warn_of_earlier(earlier: Path | None, warn: Callable[[str], object]) -> None:
    """Warn of an earlier result, if there is one, that was moved to the folder ``earlier``."""
    if earlier is not None:
        warn(f"the earlier result was moved to {earlier}: bake again the passes that the lift does not bake")


def refuse_changed(folder: LiftFolder, scene: Scene, progress: Progress = unwatched) -> None:
    """Raise PlgsError if a lift cannot continue with a ``scene``: since it last ran, a frame's photo, depth or camera
    has changed, or the set of frames or of held-out ones. Masks may change."""
    known = read_known(folder)
    if known is None:
        return
    _refuse_another(known, scene)
    there = {frame.name: frame for frame in scene.frames}
    for frame in known.frames:
        if frame.name not in there:
            fix = "Restore its files or its entry in splits.json, or lift into another folder."
            raise PlgsError("frame-gone", f"the scene no longer has frame {frame.name}", scene.folder, fix)
        if frame.held_out != (is_held_out := there[frame.name].held_out):
            raise another(f"{frame.name} is {'' if is_held_out else 'not '}held out", scene)
    refuse_other_pictures(folder, scene, progress)


def refuse_other_pictures(folder: LiftFolder, scene: Scene, progress: Progress = unwatched) -> None:
    """Raise PlgsError if a frame's photo or depth is known to have changed since the lift last ran."""
    known = read_known(folder)
    known_as = {frame.name: (frame.files, frame.read) for frame in (known.frames if known else ())}
    for frame, now in zip(scene.frames, _digests_of(scene.frames, progress), strict=True):
        before = known_as.get(frame.name, ("", ""))
        if any(one and other not in ("", one) for one, other in zip(now, before, strict=True)):
            raise another(f"the photo or the depth of {frame.name} differs, or the way they are read", scene)


def another(differs: str, scene: Scene) -> PlgsError:
    """Return the error for a scene other than the one that a lift was made from; ``differs`` says in what."""
    return PlgsError("other-scene", f"this is another scene: {differs}", scene.folder, _ANOTHER)


def complete_known_scene(folder: LiftFolder, scene: Scene) -> None:
    """Write scene.json again if an earlier version did not write it, or left out something that Blender needs."""
    known = read_known(folder)
    if os.path.exists(scene.folder) and (known is None or not known.layout):
        write_known(folder, stored_scene(scene, scene.frames, "" if known is None else known.masks))


def is_done(folder: LiftFolder) -> bool:
    """Whether nothing is left to lift, provided that no engine is running: the result is complete and unmodified, of
    the requested preset, and of the present masks and classes. Raises PlgsError if the scene has otherwise changed."""
    if not folder.has_result() or not folder.is_whole():
        return False
    manifest = read_manifest(folder.result_path)
    name = folder.request.chosen_preset.name
    if manifest.settings.get("name", name) != name:
        return False
    lifted = manifest.masks
    if not lifted and folder.is_lifted_again:  # scene.json may describe the scene of the new lift only
        return False
    lifted = lifted or masks_last_run(folder)
    if not lifted or not os.path.exists(folder.request.scene):
        return True  # not known, or gone
    scene = open_asked(folder.request)
    refuse_changed(folder, scene)
    return not have_classes_changed(folder, scene) and not masks_differ(lifted, scene)


def have_classes_changed(folder: LiftFolder, scene: Scene) -> bool:
    """Whether there is a result, and the scene's masks now have other classes than it; colours do not count."""
    try:
        result, _ = read_instances(folder.result_path / INSTANCES)
    except PlgsError:  # there is none, or a damaged one, which is written again
        return False
    tables = (result.categories, scene.classes.categories)
    before, now = ([(each.id, each.name, each.is_thing) for each in table] for table in tables)
    return before != now


def masks_last_run(folder: LiftFolder) -> str:
    """Return the digest of the masks when the lift last ran; "" if unknown. Raises PlgsError for a bad scene.json."""
    known = read_known(folder)
    return "" if known is None else known.masks


def estimates_of(folder: LiftFolder) -> tuple[str, ...]:
    """Return sentences on what was estimated in a lift's scene, and networks' licences, as known when it last ran.
    Raises PlgsError for a damaged scene.json."""
    known = read_known(folder)
    return () if known is None else known.estimated


def digest_of_masks(scene: Scene, progress: Progress = unwatched) -> str:
    """Return the start of the SHA-256 of all mask files and of how they are read, without decoding masks."""
    frames = watched(scene.frames, progress)
    read = ((frame.name, reader) for frame in frames for reader in (frame.read_mask, frame.read_detections))
    digests = [(name, reader.digest()) for name, reader in read if isinstance(reader, MaskReader | EvidenceReader)]
    return sha256(repr(digests).encode()).hexdigest()[:16]


def masks_differ(before: str, scene: Scene, now: str = "") -> bool:
    """Whether the masks of a scene, or their digest ``now``, differ from the digest ``before``; False if that is ""."""
    return before != "" and before != (now or digest_of_masks(scene))


def relink(folder: LiftFolder, scene: Path) -> LiftFolder:
    """Change the path of the scene in a lift's request to ``scene``, and also the paths of masks and depth maps inside
    it. Raises PlgsError, with the request unchanged, if a program works on the lift, the new scene cannot be read, or
    it has other frames (names, sizes, lenses or poses)."""
    if folder.is_running:
        what = "an engine is at work here"
        raise PlgsError("at-work", what, folder.path, "Wait for it, or cancel it.", code=ErrorCode.BUSY)
    request, scene = folder.request, scene.absolute()
    named: dict[str, Any] = {name: getattr(request, name) for name in ("masks", "depth", "detections")}
    inside = {name: path for name, path in named.items() if path is not None and path.is_relative_to(request.scene)}
    moved = {name: scene / path.relative_to(request.scene) for name, path in inside.items()}
    found = replace(request, scene=scene, **moved)
    opened = open_asked(found)
    known = read_known(folder)
    if known is not None:
        refuse_others(known.posed_frames(scene), opened)
    write_atomically(folder.path / "request.json", found.to_json(folder.path))
    return LiftFolder.open(folder.path)


def refuse_others(known: Sequence[PosedFrame], scene: Scene) -> None:
    """Raise PlgsError if a scene's frames differ from the known ones."""
    there = {frame.name: frame for frame in scene.frames}
    for frame in known:
        if frame.name not in there:
            raise another(f"it has no frame {frame.name}", scene)
        one, other = frame.camera, there[frame.name].camera
        numbers = ((one.camera_to_world, other.camera_to_world), (one.K, other.K))
        if one.size != other.size or not all(np.allclose(*each, rtol=0, atol=_ALIKE) for each in numbers):
            raise another(f"the camera of {frame.name} differs", scene)


def _digests_of(frames: Sequence[Frame], progress: Progress = unwatched) -> list[tuple[str, str]]:
    """Return each frame's digests: of photo and depth, of confidence and how all are read; "" for unreadable files."""
    files = digests_of_files([(frame.colour_path, frame.depth_path) for frame in frames], progress)
    trusted = digests_of_files([(frame.confidence_path,) for frame in frames])
    return [
        (found, trust and sha256(f"{trust} {frame.read_as}".encode()).hexdigest()[:16])  # "" stays "": not known
        for frame, found, trust in zip(frames, files, trusted, strict=True)
    ]


def _gone(scene: Path) -> Callable[[Any], NoReturn]:
    """Return a reader of pixels that raises PlgsError, as the scene is gone."""

    def read(size: Any = None) -> NoReturn:
        what = "the scene, whose pictures this needs, is not there"
        raise PlgsError("scene-gone", what, scene, FIND_SCENE, option="--scene")

    return read
