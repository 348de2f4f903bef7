"""Plain folders of frames, as ``formats/scannet.py`` describes them, and the split of any scene into frames for
training and for testing. Blender reads cameras and pictures with this; the engine's reader adds depth and masks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from ..errors import PlgsError
from ..job.progress import Progress, part_of, unwatched
from ..json_file import read_json_object, take_list, wrong_type
from ..scene_source import SceneSource
from .classes import ClassTable
from .frames import Camera, PosedFrame, PosedScene, Size
from .image_header import read_image_header
from .layout import check_camera, composed, files_by_stem, listed, of_most, plural, require_most, same_shape, shown_size
from .matrices import read_intrinsics, read_poses, turned, upright_turn

NOTHING_MEASURED = "no frame is held out: nothing is measured on unseen views"
_EVERY, _FIRST = 8, 4  # every 8th frame is held out, starting with the 5th
_MOST = 40  # maximum number of held-out frames; more improve no measurement, and each is rendered and scored


@dataclass(frozen=True)
class Split:
    """The names of the frames to train on and to test on, each in recording order, and warnings for the user."""

    train: tuple[str, ...]
    test: tuple[str, ...]
    warnings: tuple[str, ...] = ()


def find_split(folder: Path, names: Sequence[str], lost: Sequence[str]) -> Split:
    """Return the split of the frames ``names`` by ``splits.json`` in ``folder``, or the default one without that file.
    ``lost`` names frames without a pose. Raises PlgsError for a bad file, or if no frame is left to train on."""
    table = folder / "splits.json"
    split = read_split(table, names, lost) if table.is_file() else default_split(names)
    if not split.train:
        raise PlgsError("no-training-frame", '"train" names no frame with a pose', table, "Name frames with poses.")
    return split


def default_split(names: Sequence[str]) -> Split:
    """Hold out every 8th of the frames ``names`` for testing: the 5th, the 13th, ..., at most 40. If there are fewer
    than five, all train. The first and last frames see surfaces that no other frame sees, so both train."""
    every = max(_EVERY, -(-len(names) // _MOST))
    test = names[_FIRST::every]
    train = tuple(name for index, name in enumerate(names) if index % every != _FIRST)
    warnings = () if test else ("there are too few frames to hold one out: nothing is measured on unseen views",)
    return Split(train, tuple(test), warnings)


def read_split(path: Path, names: Sequence[str], dropped: Sequence[str]) -> Split:
    """Read ``splits.json``: {"train": [...], "test": [...]} with stems of colour images. Names in ``dropped`` (frames
    without a pose) are skipped. Raises PlgsError for names that are unknown, in both lists, or twice in one."""
    content = read_json_object(path)
    parts: dict[str, set[str]] = {}
    for key in ("train", "test"):
        listed_names = take_list(content, key, "the file", path)
        for name in listed_names:
            if not isinstance(name, str):
                raise wrong_type(key, "a list of frame names", name, "the file", path)
        parts[key] = {composed(name) for name in listed_names}
        if len(parts[key]) < len(listed_names):
            twice = sorted({name for name in listed_names if listed_names.count(name) > 1})
            raise PlgsError("twice", f'"{key}" names frames twice ({listed(twice)})', path, "Name each frame once.")
    unknown = sorted((parts["train"] | parts["test"]) - {*names} - {*dropped})
    if unknown:
        fix = "Delete these names or the file; a frame's name is its colour image's without the suffix."
        raise PlgsError("no-frame", f"the file names frames that do not exist ({listed(unknown)})", path, fix)
    both = sorted(parts["train"] & parts["test"])
    if both:
        what = f"frames are in train and in test ({listed(both)})"
        raise PlgsError("train-and-test", what, path, "Put each in one of the two.")
    chosen = parts["train"] | parts["test"]
    left_out = [name for name in names if name not in chosen]
    some = plural(len(left_out), "frame is", "frames are")
    warnings = [f"{some} left out by splits.json: {listed(left_out)}"] if left_out else []
    train, test = (tuple(name for name in names if name in parts[key]) for key in ("train", "test"))
    return Split(train, test, tuple(warnings if test else [*warnings, NOTHING_MEASURED]))


AnyFrame = TypeVar("AnyFrame", bound=PosedFrame)
NAME = "scannet"  # the name of this format
FOLDERS_FIX = "Give folders color, depth, pose and intrinsic, or let COLMAP find the poses with lift --poses colmap."


@dataclass(frozen=True, eq=False)
class PlainFolders:
    """What plain folders hold: the cameras and pictures of all frames of ``split``, by name. A frame whose picture is
    unreadable has no camera. ``names`` are all frames in recording order; ``lost`` are readable ones without a pose."""

    names: tuple[str, ...]
    cameras: Mapping[str, Camera]
    pictures: Mapping[str, Path]
    lost: tuple[str, ...]
    split: Split


def recognises(place: Path) -> bool:
    """Whether ``place`` has two or more of the plain folders, so that an error about the missing ones makes sense."""
    return sum((place / name).is_dir() for name in ("color", "pose", "intrinsic")) >= 2


def read_folders(
    folder: Path, lens_of: Callable[[Path], Camera] | None = None, progress: Progress = unwatched
) -> PlainFolders:
    """Read the poses and the headers of the pictures. ``lens_of``, if given, returns the lens for a picture; else the
    folder's intrinsics are read. Raises PlgsError if files are missing or bad for most frames."""
    pictures = files_by_stem(folder / "color", {".jpg", ".jpeg", ".png"}, FOLDERS_FIX)
    pose_files = files_by_stem(folder / "pose", {".txt"}, FOLDERS_FIX)
    fix = "Add pose/<name>.txt, or remove their colour images."
    there = require_most(list(pictures), pose_files, "pose", folder / "pose", fix)
    of_poses, of_pictures = part_of(progress, 0.0, 0.7), part_of(progress, 0.7, 1.0)
    poses = read_poses({name: pose_files[name] for name in there}, of_poses)
    lost = tuple(name for name in pictures if poses.get(name) is None)
    if len(lost) == len(pictures):
        raise PlgsError("lost-tracking", "every pose holds inf (lost tracking)", folder / "pose", FOLDERS_FIX)
    split = find_split(folder, [name for name in pictures if poses.get(name) is not None], lost)
    chosen = {*split.train, *split.test}
    kept = {name: path for name, path in pictures.items() if name in chosen}
    sizes = of_most(list(kept), lambda name: read_image_header(kept[name]).size, of_pictures)
    lenses = {name: lens_of(kept[name]) for name in sizes} if lens_of else _read_lenses(folder / "intrinsic", sizes)
    cameras = {name: lenses[name].at(pose) for name, pose in poses.items() if pose is not None and name in lenses}
    return PlainFolders(tuple(pictures), cameras, kept, lost, split)


def open_plain_folders(source: SceneSource) -> PosedScene:
    """The posed frames of a scene in plain folders, with z up. Raises PlgsError as `read_folders` does."""
    folder = source.scene
    found = read_folders(folder)
    for name, camera in found.cameras.items():
        check_camera(name, camera, found.pictures[name])
    poses = [camera.camera_to_world for camera in found.cameras.values()]
    turn, warnings = upright_turn(poses, source.up, "z", is_known=False)
    depths = files_by_stem(folder / "depth", {".png"}, FOLDERS_FIX) if (folder / "depth").is_dir() else {}
    frames = tuple(
        PosedFrame(
            name, camera.at(turned(camera.camera_to_world, turn)), name in found.split.test, found.pictures[name],
            depths.get(name),
        )
        for name, camera in found.cameras.items()
    )  # fmt: skip
    frames, blind = complete_frames(frames, "depth", lambda frame: frame.depth_path is not None)
    unread = [name for name in found.pictures if name not in found.cameras]
    lost = [left_out_warning(*each) for each in ((found.lost, "a pose"), (unread, "a readable picture")) if each[0]]
    return PosedScene(folder, frames, ClassTable(()), (*lost, *found.split.warnings, *warnings, *blind), NAME)


def complete_frames(
    frames: tuple[AnyFrame, ...], what: str, has: Callable[[AnyFrame], bool]
) -> tuple[tuple[AnyFrame, ...], tuple[str, ...]]:
    """Return the frames that have ``what``, as ``has`` tells, and warnings about the others. All frames are returned if
    most of them, or all training frames, lack it."""
    kept = tuple(frame for frame in frames if has(frame))
    lacking = [frame.name for frame in frames if not has(frame)]
    if not kept or not lacking:
        return frames, ()
    if 2 * len(lacking) > len(frames) or all(frame.held_out for frame in kept):
        return frames, (f"{len(lacking)} of {len(frames)} frames have no {what}: {listed(lacking)}",)
    blind = all(not frame.held_out for frame in kept) and any(frame.held_out for frame in frames)
    return kept, (left_out_warning(lacking, what), *([NOTHING_MEASURED] if blind else []))


def left_out_warning(names: Sequence[str], what: str) -> str:
    """The warning that frames without ``what`` are left out."""
    return plural(len(names), f"frame without {what} is", f"frames without {what} are") + f" left out: {listed(names)}"


def _read_lenses(folder: Path, sizes: Mapping[str, Size]) -> dict[str, Camera]:
    """Read each frame's intrinsics, as a camera at the origin, at its colour image's (width, height) in ``sizes``."""
    if not folder.is_dir():
        raise PlgsError("no-folder", "a folder is missing", folder, FOLDERS_FIX)
    shared_path = folder / "intrinsic_color.txt"
    base = Counter(sizes.values()).most_common(1)[0][0]
    shared = read_intrinsics(shared_path, base) if shared_path.is_file() else None
    lenses: dict[str, Camera] = {}
    for name, size in sizes.items():
        own_path = folder / f"{name}.txt"
        if own_path.is_file():
            lenses[name] = read_intrinsics(own_path, size)
        elif shared is None:
            what = "the intrinsics are missing"
            raise PlgsError("no-intrinsics", what, shared_path, "Write the colour camera's 4x4 matrix there.")
        elif not same_shape(size, base):
            what = f"frame {name} is {shown_size(size)}, which is not the shape of {shown_size(base)}"
            fix = f"Give the frame intrinsics of its own, intrinsic/{name}.txt."
            raise PlgsError("other-shape", what, shared_path, fix)
        else:
            lenses[name] = shared.resized(*size)
    return lenses
