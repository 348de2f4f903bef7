"""Check every frame's pixels before any work starts, so that a bad file is found in seconds, not after an hour."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..errors import MEMORY_IS_GONE, PlgsError
from ..job.progress import part_of, unwatched
from ..posed.classes import VOID
from ..posed.frames import size_within
from ..posed.image_header import check_image_file
from ..posed.layout import listed, plural
from .depth import Thumbnail, measure_overlap
from .files_of_frames import IMAGES
from .frame import Frame, PanopticMask, Scene, Size
from .frame_choice import evenly_spread
from .ground_truth import GroundTruthReader
from .masks import KeptMask, OtherClasses
from .opening import complete
from .pixels import distinct_ids, largest_of_16_bits
from .view import Progress, read_ahead

_COLOURS_DECODED = 16
_DECODED = 0.85  # share of the time for all files; the rest is for the overlap
_MEDIAN_STEP = 7  # every seventh pixel is enough for the median depth
_LOOKS_LIKE_METRES = 0.1  # metres; a scene in millimetres has some depth above this
_LOOKS_TOO_FAR = 15.0
_BITS = (8, 10, 12, 14)  # bit depths of sensors whose photos are stored unscaled in 16-bit PNGs
_SPARSE_DEPTH = 0.05
_DISAGREEING = 0.4
_LONELY_SHARE = 0.2
_POSE_RULES = "camera-to-world with x right, y down, z forward, in metres"


@dataclass(frozen=True)
class DepthFacts:
    """A frame's depth: its ``range`` (nearest, median, farthest, in metres), and the ``share`` of pixels with depth."""

    size: Size
    range: tuple[float, float, float]
    share: float


@dataclass(frozen=True)
class MaskFacts:
    """A frame's mask: the number of ``segments`` with pixels, the ids of segments without pixels (``unpainted``), and
    the share of each class, as pairs (class id, share)."""

    size: Size
    segments: int
    unpainted: tuple[int, ...]
    class_pixels: tuple[tuple[int, float], ...]


@dataclass(frozen=True)
class FrameFacts:
    """Facts of a frame's pixels; ``depth`` or ``mask`` is None without any. ``unknown_truth`` are classes of the ground
    truth that the masks' table lacks. ``brightest`` is the largest value of a 16-bit photo, None if not decoded."""

    name: str
    depth: DepthFacts | None
    mask: MaskFacts | None
    unknown_truth: frozenset[int | str]
    brightest: int | None


_Look = tuple[FrameFacts, Thumbnail | None, Frame]


@dataclass(frozen=True, eq=False)
class Survey:
    """The result of a survey: the scene without unreadable frames, facts of each frame, and further warnings."""

    scene: Scene
    frames: tuple[FrameFacts, ...]
    warnings: tuple[str, ...]


def survey_scene(scene: Scene, progress: Progress = unwatched, keep_within: Size | None = None) -> Survey:
    """Check every file of a scene and how the frames fit together, in about 20 ms for a 640x480 frame. Depth and masks
    may be missing. Depth, masks and ground truth of all frames are decoded; all colour files are checked for damage,
    and 16 of them are decoded. Frames whose files cannot be read, up to half, are named in the warnings. Raises
    PlgsError for the first fault that prevents a lift. Masks are kept in memory at the size that frames have within
    ``keep_within``, so that reading them later at this size decodes no file."""
    looks, scene, warnings = _readable(scene, part_of(progress, 0.0, _DECODED, 100), keep_within)
    facts = [fact for fact, *_ in looks]
    thumbnails = [thumbnail for _, thumbnail, _ in looks if thumbnail is not None]
    depths = [fact.depth for fact in facts if fact.depth is not None]
    farthest = max((depth.range[2] for depth in depths), default=_LOOKS_LIKE_METRES)
    if farthest < _LOOKS_LIKE_METRES:
        what = f"depth looks like metres, not millimetres (the largest value is {farthest * 1000.0:.0f})"
        fix = "Multiply it by 1000 and save it as 16-bit PNGs."
        raise PlgsError("depth-not-millimetres", what, (scene.frames[0].depth_path or scene.folder).parent, fix)
    training = [fact.mask for fact, frame in zip(facts, scene.frames, strict=True) if not frame.held_out]
    classes_seen = {class_id for mask in training if mask is not None for class_id, _ in mask.class_pixels}
    if classes_seen == {VOID}:  # without any masks the set is empty, which is allowed
        fix = "Give masks that have segments in the frames to train on."
        raise PlgsError("masks-empty", "the masks are empty", scene.folder, fix)
    overlap_warnings = _overlap_warnings(scene, thumbnails, part_of(progress, _DECODED, 1.0, 100)) if depths else ()
    return Survey(scene, tuple(facts), (*warnings, *_pixel_warnings(facts), *overlap_warnings))


def _readable(scene: Scene, tick: Progress, keep_within: Size | None) -> tuple[list[_Look], Scene, tuple[str, ...]]:
    """Return the facts of the frames, the scene without unreadable frames, and warnings that name the unreadable ones.
    ``tick`` and ``keep_within``: see `survey_scene`. Raises PlgsError for too many unreadable ones, if memory runs out,
    and for a wrong class table or an unreadable ground truth."""
    looks: dict[str, _Look] = {}
    errors: dict[str, PlgsError] = {}
    decoded = {frame.name for frame in evenly_spread(scene.frames, _COLOURS_DECODED)}

    def look(frame: Frame) -> _Look | PlgsError:
        truth = frame.read_ground_truth
        unknown = truth.unknown() if isinstance(truth, GroundTruthReader) else frozenset[int | str]()
        try:
            return _look(frame, unknown, keep_within, decode=frame.name in decoded)
        except OtherClasses:  # the table is wrong, not this frame's file
            raise
        except PlgsError as error:
            if MEMORY_IS_GONE in error.what:  # the file may be good: no reason to leave the frame out
                raise
            return error

    for done, (frame, found) in enumerate(zip(scene.frames, read_ahead(scene.frames, look), strict=True), start=1):
        if isinstance(found, PlgsError):
            errors[frame.name] = found
        else:
            looks[frame.name] = found
        tick(done, len(scene.frames))
    if not errors:
        return list(looks.values()), replace(scene, frames=tuple(frame for *_, frame in looks.values())), ()
    first = next(iter(errors.values()))
    _, gone, warnings = complete(scene.frames, "readable files", lambda frame: frame.name in looks)
    if not gone:
        raise first
    kept = tuple(frame for *_, frame in looks.values())
    scene = replace(scene, frames=kept, left_out=(*scene.left_out, *gone))
    return list(looks.values()), scene, (f"{gone[0]} (the first: {first.problem})", *warnings)


def _look(frame: Frame, unknown_truth: frozenset[int | str], keep_within: Size | None, decode: bool) -> _Look:
    brightest = _check_colour(frame, decode)
    measured, thumbnail, mask = None, None, None
    if frame.read_depth is not None:
        depth = frame.read_depth(None)
        measured = _depth_facts(frame, depth)
        thumbnail = Thumbnail.of(frame.name, frame.camera, depth)
    if frame.read_mask is not None:
        whole = frame.read_mask(None)
        mask = _mask_facts(whole)
        if frame.read_detections is not None:
            frame.read_detections(size_within(frame.size, keep_within or frame.size))
        if keep_within is not None:
            frame = replace(frame, read_mask=KeptMask.of(whole, size_within(frame.size, keep_within), frame.read_mask))
    return FrameFacts(frame.name, measured, mask, unknown_truth, brightest), thumbnail, frame


def _check_colour(frame: Frame, decode: bool) -> int | None:
    """Return the largest value of a 16-bit photo; None for other photos, and unless ``decode`` is set."""
    path, is_image = frame.colour_path, frame.colour_path.suffix.lower() in IMAGES
    if decode:
        frame.read_colour(None)
    elif is_image:
        check_image_file(path)
    return largest_of_16_bits(path) if decode and is_image else None


def _depth_facts(frame: Frame, depth: NDArray[np.float32]) -> DepthFacts:
    valid = depth[depth > 0.0]
    if not len(valid):
        where = frame.depth_path or frame.colour_path
        raise PlgsError("depth-zero", "the depth map is 0 everywhere", where, "Give depth, or leave this frame out.")
    return DepthFacts(
        size=(depth.shape[1], depth.shape[0]),
        range=(float(valid.min()), float(np.median(valid[::_MEDIAN_STEP])), float(valid.max())),
        share=len(valid) / depth.size,
    )


def _mask_facts(mask: PanopticMask) -> MaskFacts:
    ids, counts = distinct_ids(mask.ids)
    pixels = dict(zip(ids.tolist(), counts.tolist(), strict=True))
    by_class = {0: pixels.get(0, 0)}  # 0: pixels without a segment
    for segment in mask.segments:
        if segment.id in pixels:
            by_class[segment.class_id] = by_class.get(segment.class_id, 0) + pixels[segment.id]
    return MaskFacts(
        size=(mask.ids.shape[1], mask.ids.shape[0]),
        segments=len(pixels.keys() - {0}),
        unpainted=tuple(segment.id for segment in mask.segments if segment.id not in pixels),
        class_pixels=tuple((class_id, count / mask.ids.size) for class_id, count in sorted(by_class.items())),
    )


def _pixel_warnings(facts: Sequence[FrameFacts]) -> Iterable[str]:
    yield from _colour_warnings({fact.name: fact.brightest for fact in facts if fact.brightest is not None})
    yield from _depth_warnings({fact.name: fact.depth for fact in facts if fact.depth is not None})
    yield from _mask_warnings({fact.name: fact.mask for fact in facts if fact.mask is not None})
    if unknown := sorted(frozenset().union(*(fact.unknown_truth for fact in facts)), key=str):  # names and numbers mix
        yield f"classes {listed(unknown)} of the ground truth are not in the masks' table and count as void"


def _colour_warnings(brightest: Mapping[str, int]) -> Iterable[str]:
    """Yield warnings about 16-bit photos, into which cameras write 10, 12 or 14 bits. PLGS does not brighten them."""
    name = max(brightest, key=brightest.__getitem__, default="")
    bits = next((bits for bits in _BITS if 0 < brightest.get(name, 0) < 1 << bits), None)  # 0: a covered lens
    if bits is not None:
        how = "dark" if bits > 12 else "nearly black"
        yield (
            f"photos of 16 bits are {how}, as if they had {bits} bits (the largest value is {brightest[name]}, "
            f"in {name}): they are read as they are; if so, multiply their values by {1 << 16 - bits} and write them "
            "again"
        )


def _depth_warnings(depths: Mapping[str, DepthFacts]) -> Iterable[str]:
    typical = float(np.median([depth.range[1] for depth in depths.values()])) if depths else 0.0
    if typical > _LOOKS_TOO_FAR:
        yield f"the median depth is {typical:.0f} m, which is far for a room: is it in millimetres?"
    if sparse := [name for name, depth in depths.items() if depth.share < _SPARSE_DEPTH]:
        some = plural(len(sparse), "frame has", "frames have")
        yield f"{some} depth on less than 5 % of the pixels: {listed(sparse)}"


def _mask_warnings(masks: Mapping[str, MaskFacts]) -> Iterable[str]:
    if blank := [name for name, mask in masks.items() if not mask.segments]:
        yield f"{plural(len(blank), 'frame has', 'frames have')} an empty mask: {listed(blank)}"
    if unpainted := {name: mask.unpainted for name, mask in masks.items() if mask.unpainted}:
        name, ids = next(iter(unpainted.items()))
        total, first = sum(map(len, unpainted.values())), f"segment {ids[0]} of frame {name}"
        yield f"{total} segments of the masks' table have no pixel in the PNGs (the first: {first})"


def _overlap_warnings(scene: Scene, thumbnails: Sequence[Thumbnail], tick: Progress) -> Iterable[str]:
    if len(thumbnails) < 2:
        yield "there is only one frame: nothing can be checked against another view"
        return
    overlap = measure_overlap(thumbnails, tick)
    if not overlap.overlaps:
        where = scene.folder / "pose" if (scene.folder / "pose").is_dir() else scene.folder
        fix = f"Check that poses are {_POSE_RULES}, and that depth is in millimetres."
        raise PlgsError("no-overlap", "no two frames see the same surface", where, fix)
    if overlap.agreement < _DISAGREEING:
        yield (
            f"frames disagree about where surfaces are: only {overlap.agreement:.0%} of the points that another frame "
            "looks at lie where its depth says. Are poses "
            f"{_POSE_RULES}, and is depth along the optical axis, in millimetres?"
        )
    if len(overlap.lonely) > _LONELY_SHARE * len(thumbnails):
        lonely = plural(len(overlap.lonely), "frame hardly overlaps", "frames hardly overlap")
        yield f"{lonely} with any other: {listed(overlap.lonely)}"
