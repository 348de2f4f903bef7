"""Open a scene: a format's reader returns posed pictures, to which masks, ground truth and ``splits.json`` are added.
If the scene is one file, these lie in a folder of the same name beside it."""

from __future__ import annotations

import gc
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import ErrorCode, PlgsError, reading
from ..job.progress import Progress, part_of, unwatched
from ..job.request import refuse_unwritable_name
from ..posed.classes import ClassTable
from ..posed.frames import Camera
from ..posed.image_header import read_image_header
from ..posed.layout import check_camera, listed, of_most
from ..posed.matrices import turned, upright_turn
from ..posed.plain_folders import NAME, complete_frames, find_split
from ..scene_source import SCENE_FORMAT_NAMES, SceneSource, UpAxis
from .depth import DepthMap, depth_check
from .estimated_depth import with_estimated_depth
from .files_of_frames import kept_pixels, says_what_counts
from .formats import Capture, SceneFormat, Shot, find_format
from .formats.lens import UNDISTORTED, Distortion, undistorted
from .formats.photos import LET_COLMAP, photos_in
from .frame import Frame, Inferred, LeftOut, Scene, doubts, left_out
from .frame_choice import evenly_spread
from .ground_truth import open_ground_truth
from .made import estimates, made_depth, scale_of
from .mask_fit import KeptPixels, Pictured
from .masks import MASK_FOLDER, find_masks, no_masks
from .mesh_depth import is_mesh, with_mesh_depth
from .pixels import ColourReader, decode, opaque
from .view import watched

_FAR_ASIDE = 0.2
_ASIDE = "the principal point is far from the middle (are the intrinsics in pixels of the colour images?)"
_KEPT = (
    "some pixels do not count (mask_path, black and white pictures in masks, or transparent ones): they have no class "
    "and no depth"
)
_LOOKED_AT = 8  # photos with an alpha channel that are looked at: many have one that is opaque everywhere


def open_scene(
    folder: Path, masks: Path | None = None, *, up: UpAxis = "z", scene_format: str | None = None,
    depth: Path | None = None, mask_format: str | None = None, classes: str | None = None,
    detections: Path | None = None,
) -> Scene:  # fmt: skip
    """Open the scene in a folder or file. The arguments are the fields of a SceneSource; see ``open_asked``."""
    return open_asked(SceneSource(folder, masks, up, scene_format, depth, mask_format, classes, detections))


def open_asked(source: SceneSource, progress: Progress = unwatched) -> Scene:
    """Open a scene. Images are decoded only to settle doubts about masks and depth maps, either of which may be missing
    (see ``require_liftable``). Raises PlgsError for the first problem; ``survey_scene`` also inspects the pixels."""
    is_on = gc.isenabled()
    gc.disable()  # repeated collections over all frames would take a quarter of the time, in long pauses
    try:
        return _opened(source, progress)
    finally:
        if is_on:
            gc.enable()


def _opened(source: SceneSource, progress: Progress) -> Scene:
    parts = (0.0, 0.45), (0.45, 0.55), (0.55, 1.0)  # shares of the time, measured on folders with COCO's masks
    of_scene, fitting = (part_of(progress, 0.0, 0.5), part_of(progress, 0.5, 1.0)) if source.depth else [progress] * 2
    of_shots, of_frames, of_masks = (part_of(of_scene, *part) for part in parts)
    place = Path(source.scene)
    for path in (place, source.masks, source.detections, source.depth):
        if path is not None:
            refuse_unwritable_name(Path(path))
    reader = find_format(place, source.scene_format)
    with reading(place, "Check that it exists, and its permissions."):
        capture = reader.read(place, of_shots)
    unreadable = capture.unreadable
    if 2 * len(unreadable) > len(capture.shots) + len(unreadable):
        raise next(iter(unreadable.values()))
    _refuse_repeated_names(capture.shots, place)
    for shot in capture.shots:
        check_camera(shot.name, shot.camera, shot.colour_path)
    table = splits_path(place)
    beside, split = table.parent, capture.split
    if split is None or (reader.name != NAME and table.is_file()):  # plain folders have read theirs
        split = find_split(beside, [shot.name for shot in capture.shots], [*capture.lost, *unreadable])
    chosen, held_out = {*split.train, *split.test}, frozenset(split.test)
    shots = [shot for shot in capture.shots if shot.name in chosen]
    poses = [shot.camera.camera_to_world for shot in capture.shots]
    turn, turn_warnings = upright_turn(poses, source.up, capture.up, is_known=capture.up_is_known)
    scale = 1.0 if reader.name == NAME else scale_of(beside)  # plain folders have metres, and Blender reads them itself
    cameras = {shot.name: scaled(shot.camera.at(turned(shot.camera.camera_to_world, turn)), scale) for shot in shots}
    sizes = {shot.name: shot.camera.size for shot in shots}
    depths, has_made_depth = ({}, False) if source.depth is not None else _depths(shots, beside, scale)
    kept = _kept_pixels(shots, beside)
    unmasked, pictured = {}, {}
    for shot in watched(shots, of_frames):
        name, counts = shot.name, kept.get(shot.name)
        unmasked[name] = _frame(shot, cameras[name], name in held_out, depths.get(name), counts)
        turn_of_photo = read_image_header(shot.colour_path).orientation if shot.read_colour is None else 1
        read, lens = unmasked[name].read_colour, _bent_lens(shot)
        pictured[name] = Pictured(read, shot.camera.size, turn_of_photo, lens, counts)
    mask_set = find_masks(source, beside, pictured, of_masks)
    truth, truth_warnings, of_truth = open_ground_truth(beside, sizes, mask_set)
    points = None if capture.points is None else capture.points.turned(scale * turn)
    readers, over = mask_set.readers, mask_set.over
    frames = tuple(
        replace(one, read_mask=readers.get(name), read_ground_truth=truth.get(name), read_detections=over.get(name))
        for name, one in unmasked.items()
    )
    masks = Path(source.masks or beside)
    told = tuple(estimates(beside, masks, has_made_depth=has_made_depth, has_unit=capture.has_unit))
    gone = (*left_out("a pose", capture.lost), *left_out("a readable picture", unreadable), *capture.left_out)
    of_parts = (*capture.inferred, *mask_set.inferred, *of_truth, *told)
    inferred = (*_inferred(source, reader, capture, beside, turn), *of_parts)
    if source.depth is not None:
        maps = Path(source.depth)
        frames, mapless, of_depth = (
            with_mesh_depth(frames, maps, scale * turn, fitting)
            if is_mesh(maps)
            else with_estimated_depth(frames, maps, points, pictured, fitting)
        )
        gone, inferred = (*gone, *mapless), (*inferred, *of_depth)
    frames, blind, of_blind = complete(frames, "readable depth", lambda frame: frame.read_depth is not None)
    frames, bare, of_bare = complete(frames, "a readable mask", lambda frame: frame.read_mask is not None)
    gone = (*gone, *blind, *bare)
    of_lenses = _of_lenses(shots, cameras, kept)
    alike = _alike(sizes, mask_set.classes)
    of_files = (*capture.warnings, *of_blind, *of_bare, *mask_set.warnings, *alike, *truth_warnings)
    return Scene(
        folder=place,
        frames=frames,
        classes=mask_set.classes,
        warnings=(*map(str, gone), *split.warnings, *turn_warnings, *of_lenses, *doubts(inferred), *of_files),
        left_out=gone,
        inferred=inferred,
        format=reader.name,
        points=points,
        turn=None if np.array_equal(turn, np.eye(3)) else turn,
        fps=capture.fps,
        estimated=doubts(told),
    )


def scaled(camera: Camera, scale: float) -> Camera:
    """Return the same camera in a world whose lengths are ``scale`` times as long."""
    pose = camera.camera_to_world.copy()
    pose[:3, 3] *= scale
    return camera.at(pose)


def splits_path(place: Path) -> Path:
    """Return where a scene's splits.json belongs: in its folder, or in one named like its file."""
    return (place if place.is_dir() else place.with_suffix("")) / "splits.json"


def _inferred(
    source: SceneSource, reader: SceneFormat, capture: Capture, beside: Path, turn: NDArray[np.float64]
) -> Iterable[Inferred]:
    """Yield what was inferred about format, split and up axis because neither the user nor a file says it."""
    if source.scene_format is None:
        looks_for = next(each.looks_for for each in SCENE_FORMAT_NAMES if each.name == reader.name)
        yield Inferred("format", f"the format is {reader.name}", f"it looks for {looks_for}", is_doubtful=False)
    if (capture.split is None or reader.name == NAME) and not (beside / "splits.json").is_file():
        yield Inferred("split", "frames are held out at equal steps", "there is no splits.json", is_doubtful=False)
    if source.up == "z" and capture.up is None:
        is_turned = not np.array_equal(turn, np.eye(3))
        taken = "the world is turned so that the cameras stand upright" if is_turned else "z is up, as for the cameras"
        yield Inferred("up axis", taken, "the format does not say which way is up", is_doubtful=is_turned)


def complete(
    frames: tuple[Frame, ...], lacks: str, has: Callable[[Frame], bool]
) -> tuple[tuple[Frame, ...], tuple[LeftOut, ...], tuple[str, ...]]:
    """Leave out frames that lack something (`complete_frames`). Returns the kept ones, those left out, and warnings."""
    kept, warnings = complete_frames(frames, lacks, has)
    names = {frame.name for frame in kept}
    gone = left_out(lacks, (frame.name for frame in frames if frame.name not in names))
    return kept, gone, warnings[len(gone) :]


def _refuse_repeated_names(shots: Sequence[Shot], place: Path) -> None:
    if not shots:
        has_photos = place.is_dir() and photos_in(place) is not None
        fix = f"Record again with an app that keeps poses, or {LET_COLMAP}."
        code = ErrorCode.NO_POSES if has_photos else ErrorCode.BAD_INPUT
        raise PlgsError("no-poses", "no picture has a pose", place, fix, code=code)
    twice = [name for name, count in Counter(shot.name for shot in shots).items() if count > 1]
    if twice:
        what = f"frames share a name ({listed(twice)})"
        raise PlgsError("names-clash", what, place, "Give each picture a name of its own.")


def _of_lenses(shots: Sequence[Shot], cameras: Mapping[str, Camera], kept: Mapping[str, KeptPixels]) -> list[str]:
    """Return warnings of lenses that look wrong, of pixels that do not count, and of distortion that is removed."""
    middles = {name: (lens.cx / lens.width, lens.cy / lens.height) for name, lens in cameras.items()}
    aside = [name for name, middle in middles.items() if max(abs(share - 0.5) for share in middle) > _FAR_ASIDE]
    is_bent = any(shot.distortion.bends for shot in shots)
    possible = ((f"{_ASIDE}: {listed(aside)}", aside), (_KEPT, kept), (UNDISTORTED, is_bent))
    return [warning for warning, is_so in possible if is_so]


def _depths(shots: Sequence[Shot], beside: Path, scale: float) -> tuple[dict[str, DepthMap], bool]:
    """The shots' depth in metres, and whether `engine depth` made it, which is used only if no shot has own depth."""
    of_shot = {shot.name: shot for shot in shots}
    found = of_most(list(of_shot), lambda name: _readable_depth(of_shot[name]))
    measured = {name: each for name, each in found.items() if each is not None}
    depths = measured or made_depth(beside, {shot.name: shot.camera for shot in shots})
    if scale != 1.0:
        depths = {name: each.through(lambda values: values * np.float32(scale)) for name, each in depths.items()}
    return depths, bool(depths) and not measured


def _readable_depth(shot: Shot) -> DepthMap | None:
    if shot.depth is not None and shot.depth.fault is not None:
        raise shot.depth.fault
    return shot.depth


def _kept_pixels(shots: Sequence[Shot], beside: Path) -> dict[str, KeptPixels]:
    """Return which pixels of each shot count, if its own file or black-and-white pictures beside the masks say so."""
    folder = beside / MASK_FOLDER
    paths = {shot.name: shot.kept_pixels for shot in shots if shot.kept_pixels is not None}
    if not paths and folder.is_dir() and says_what_counts(folder):
        paths = kept_pixels(folder, [shot.name for shot in shots])
    lenses = {shot.name: _bent_lens(shot) for shot in shots}
    seen_through = [shot for shot in shots if not paths and shot.read_colour is None and _has_alpha(shot.colour_path)]
    if any(not opaque(shot.colour_path).all() for shot in evenly_spread(seen_through, _LOOKED_AT)):
        return {shot.name: KeptPixels(shot.colour_path, lenses[shot.name], is_photo=True) for shot in seen_through}
    return {name: KeptPixels(path, lenses[name]) for name, path in paths.items()}


def _has_alpha(path: Path) -> bool:
    return path.suffix.lower() == ".png" and read_image_header(path).channels == 4


def _bent_lens(shot: Shot) -> tuple[Camera, Distortion] | None:
    return (shot.camera, shot.distortion) if shot.distortion.bends else None


def _frame(shot: Shot, camera: Camera, held_out: bool, depth: DepthMap | None, kept: KeptPixels | None) -> Frame:
    """Return a shot's frame, still without mask and ground truth. ``depth`` becomes 0 outside the pixels ``kept``."""
    path, bend = shot.colour_path, shot.distortion
    read = shot.read_colour or partial(decode, path, as_colour=True)
    if bend.bends:
        bent, lens = read, shot.camera
        read = lambda: undistorted(bent(), lens, bend, path, smooth=True)  # noqa: E731
        if depth is not None:
            depth = depth.through(lambda values: undistorted(values, lens, bend, path, smooth=False))
    if depth is not None:
        depth = depth.through(depth_check(shot.name, depth.path))
    if depth is not None and kept is not None:
        depth = depth.through(lambda values: values * kept((values.shape[1], values.shape[0])))
    distortion = (bend.is_fisheye, *bend.numbers) if bend.bends else ()
    return Frame(
        name=shot.name,
        camera=camera,
        held_out=held_out,
        colour_path=path,
        depth_path=None if depth is None else depth.path,
        read_colour=ColourReader(read),
        read_depth=depth,
        read_mask=None,
        confidence_path=None if depth is None else depth.confidence,
        read_as=" ".join(map(str, (*distortion, *(() if depth is None else depth.unusual)))),
        file_shows_colour=shot.read_colour is None and not bend.bends,
        read_kept=kept,
    )


def _alike(frames: Iterable[str], classes: ClassTable) -> Iterable[str]:
    """Yield warnings about names that are equal, or differ only in case."""
    for found in _alike_names((name, name) for name in frames):
        what = f"frames {listed(found)} have names that differ only in capitals"
        yield f"{what}: rename all but one, as their passes replace each other on disks of Windows and macOS"
    for found in _alike_names((each.name, f"{each.id} {each.name}") for each in classes.categories):
        if len({named.partition(" ")[2] for named in found}) == 1:
            what, how = "the same name", "with its number in the masks as id"
        else:
            what, how = "names that differ only in capitals", "in the capitals of the other"
        join = f'to join them, write into = "..." for one in classes.toml, {how}'
        yield f"classes {listed(found)} have {what}, and are kept apart: {join}"


def _alike_names(named: Iterable[tuple[str, str]]) -> list[list[str]]:
    """Group pairs of (name, label) whose names are equal but for case. Returns the labels of each group of several."""
    found: dict[str, list[str]] = {}
    for name, text in named:
        found.setdefault(name.casefold(), []).append(text)
    return [each for each in found.values() if len(each) > 1]


def require_liftable(scene: Scene) -> None:
    """Raise PlgsError if a scene has no masks or no depth, both of which a lift needs."""
    if not scene.has_depth:
        fix = "Make depth (engine depth, Make Depth), or give a mesh or a folder of depth maps with --depth."
        without = [frame.name for frame in scene.frames if frame.read_depth is None]
        some = f"{len(without)} of {len(scene.frames)} frames have no depth ({listed(without)})"
        what = "the scene has no depth" if len(without) == len(scene.frames) else some
        raise PlgsError("no-depth", what, scene.folder, fix, option="--depth")
    if not scene.has_masks:
        raise no_masks(scene.folder)


def open_scene_to_lift(source: SceneSource, progress: Progress = unwatched) -> Scene:
    """Open a scene for a lift, as ``open_asked`` does. Raises PlgsError also if it has no masks or no depth."""
    scene = open_asked(source, progress)
    require_liftable(scene)
    return scene
