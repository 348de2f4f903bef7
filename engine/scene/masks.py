"""Find and read a scene's panoptic masks: readers of formats return numbered segments, the class table classes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from zlib import compress, decompress

import numpy as np

from ..errors import ErrorCode, PlgsError, reading
from ..job.progress import Progress, part_of, unwatched
from ..posed.classes import VOID, ClassLabel, ClassTable
from ..posed.layout import listed
from ..scene_source import SceneSource
from .class_choice import FILE_NAME, find_class_choice
from .class_map import ClassMap, class_map
from .detection_fit import fitted
from .files_of_frames import digests_of_files, says_what_counts
from .frame import Inferred, PanopticMask, Segment, Size, mapped
from .mask_fit import Pictured, Placement, paired, placements
from .mask_formats import MASK_FORMATS, FoundSegment, MaskSource, StoredMask, find_mask_format
from .numbering import numbered, other_numberings
from .overlapping import Detections, EvidenceReader, open_detections
from .pixels import resize_nearest

MASK_FOLDER = "masks"  # the folder of a scene that may hold masks of any format


def no_masks(scene: Path) -> PlgsError:
    """The error for a scene without masks."""
    fix = "Give masks with --masks, such as COCO panoptic ones, or let the command segment make them."
    return PlgsError("no-masks", "there are no masks", scene, fix, code=ErrorCode.NO_MASKS, option="--masks")


class OtherClasses(PlgsError):
    """The error for a readable mask with classes that its table lacks: the table is wrong, not this file."""


@dataclass(frozen=True)
class MaskReader:
    """Reads one frame's ``stored`` mask and gives segments the classes of ``known``. Labels in ``void`` are ignored
    unless the table has them. ``fuses`` joins stuff of one class into one segment. Messages call the class table
    ``table``, and suggest ``others`` as well. ``placement`` maps the mask into the picture."""

    stored: StoredMask
    known: ClassMap
    void: frozenset[int]
    fuses: bool
    table: str
    others: str = ""
    placement: Placement | None = None

    def __call__(self, size: Size | None = None) -> PanopticMask:
        """Read the mask at ``size`` (width, height) or its own. Raises OtherClasses, and PlgsError for a bad file."""
        found = self.stored.read()
        unknown = sorted({one.label for one in found.segments if self._class_of(one) is None})
        if unknown:
            fix = f"Add them to {FILE_NAME} beside the masks: [[class]] with id, name, thing (or into){self.others}."
            what = f"class ids {listed(unknown)} are not in {self.table}"
            raise OtherClasses("unknown-classes", what, self.stored.path, fix)
        segments = [segment for one in found.segments if (segment := self._segment(one)) is not None]
        new_id = {one.id: one.id for one in segments}
        if self.fuses:
            segments, new_id = fused(segments)
        ids = found.ids if self.placement is None else self.placement(found.ids)
        if any(new_id.get(one.id) != one.id for one in found.segments):  # also for void ones, which become 0
            ids = mapped(ids, new_id, np.zeros(1, np.int32))
        return PanopticMask(resize_nearest(ids, size) if size else ids, tuple(segments))

    def digest(self) -> str:
        """Return the start of the SHA-256 of the mask's files and of how they are read, without decoding them."""
        classes = [(each.id, each.is_thing) for each in self.known.classes.categories]
        read_as = (sorted(self.known.class_of.items()), self.known.others, classes, sorted(self.void), self.fuses)
        kept = None if self.placement is None or self.placement.kept is None else self.placement.kept.path
        files = digests_of_files([self.stored.files, *([(kept,)] if kept else [])])
        placed = "" if self.placement in (None, Placement()) else f" {self.placement}"
        return sha256(f"{files} {self.stored.about} {read_as}{placed}".encode()).hexdigest()[:16]

    def _class_of(self, one: FoundSegment) -> int | None:
        """Return the class id of a segment: 0 for void, None if its label is unknown."""
        known = self.known.class_of.get(one.label, self.known.others)
        return VOID if known is None and one.label in self.void else known

    def _segment(self, one: FoundSegment) -> Segment | None:
        class_id = self._class_of(one)
        if class_id is None or class_id == VOID:
            return None
        is_thing = self.known.classes[class_id].is_thing
        is_group = is_thing and not one.has_instance  # the whole area of a class, perhaps of several objects
        track = one.track if is_thing else None
        return Segment(one.id, class_id, is_thing and not is_group, one.score, is_group, track)


@dataclass(frozen=True, eq=False)
class KeptMask:
    """A decoded mask that is kept in memory, ``packed``, at one ``size``; ``read`` reads it again for other sizes."""

    size: Size
    packed: bytes
    segments: tuple[Segment, ...]
    read: Callable[[Size | None], PanopticMask]

    @classmethod
    def of(cls, mask: PanopticMask, size: Size, read: Callable[[Size | None], PanopticMask]) -> KeptMask:
        """Reduce the full-size ``mask`` to ``size`` and keep it."""
        return cls(size, compress(resize_nearest(mask.ids, size).tobytes(), 1), mask.segments, read)

    def __call__(self, size: Size | None = None) -> PanopticMask:
        """Return the mask at ``size`` (width, height) or its own. Raises what ``read`` raises."""
        if size != self.size:
            return self.read(size)
        return PanopticMask(np.frombuffer(decompress(self.packed), np.int32).reshape(size[::-1]), self.segments)


def fused(segments: Sequence[Segment]) -> tuple[list[Segment], dict[int, int]]:
    """Join the stuff segments, and the groups, of each class into one with the id and score of the first. Returns the
    segments, and the new id of each old one."""
    first: dict[int, int] = {}
    new_id, kept = {}, []
    for one in segments:
        new_id[one.id] = one.id if one.is_thing else first.setdefault(one.class_id, one.id)
        if new_id[one.id] == one.id:
            kept.append(one)
    return kept, new_id


@dataclass(frozen=True)
class MaskSet:
    """The masks of a scene's frames: the class table, a reader by frame, warnings, and what was ``inferred`` because no
    file says it. ``over`` are the readers of detections that lie over the masks, by frame."""

    classes: ClassTable = ClassTable(())
    readers: Mapping[str, MaskReader] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    inferred: tuple[Inferred, ...] = ()
    over: Mapping[str, EvidenceReader] = field(default_factory=dict)


def find_masks(source: SceneSource, scene: Path, pictured: Mapping[str, Pictured], progress: Progress) -> MaskSet:
    """Find the masks of the frames in ``pictured``, and detections over them; return an empty set if the scene has no
    masks. Raises PlgsError for bad files."""
    place = mask_place(scene, None if source.masks is None else Path(source.masks))
    kept = [each.kept.path for each in pictured.values() if each.kept is not None]
    are_kept = source.masks is None and place is not None and any(path.is_relative_to(place) for path in kept)
    if place is None or (are_kept and place == scene / MASK_FOLDER):  # mask_path's pictures do not hold classes
        return MaskSet()
    sizes = {name: each.size for name, each in pictured.items()}
    detections, rest = None, progress
    if source.detections is not None:
        detections = open_detections(source.detections, place, sizes, part_of(progress, 0.0, 0.5))
        rest = part_of(progress, 0.5, 1.0)
    return open_masks(
        place, [*pictured], mask_format=source.mask_format, classes=source.classes, pictured=pictured,
        detections=detections, progress=rest,
    )  # fmt: skip


def mask_place(scene: Path, masks: Path | None) -> Path | None:
    """Return where a scene's masks are: the named path, else the scene's own folder or its subfolder ``masks``, else
    None. A folder of COCO panoptic PNGs is replaced by its JSON table, without which they mean nothing."""
    if masks is not None:
        table = masks.with_name(f"{masks.name}.json")
        return table if masks.name.startswith("panoptic") and masks.is_dir() and table.is_file() else masks
    if any(each.in_scene and each.recognises(scene) for each in MASK_FORMATS):
        return scene
    folder = scene / MASK_FOLDER
    return folder if folder.is_dir() and not says_what_counts(folder) else None


def open_masks(
    place: Path,
    names: Sequence[str],
    *,
    mask_format: str | None = None,
    classes: str | None = None,
    pictured: Mapping[str, Pictured] | None = None,
    detections: Detections | None = None,
    progress: Progress = unwatched,
) -> MaskSet:
    """Open the masks at ``place`` of the frames ``names``, reading only headers and tables. ``mask_format`` names their
    format; None recognises it. ``classes``: see ``find_class_choice``. With ``pictured``, some masks and pictures are
    compared if names, sizes or lenses are doubtful. ``detections`` lie over masks. Raises PlgsError for bad files."""
    inferred: tuple[Inferred, ...] = ()
    placed: dict[str, Placement] = {}
    if pictured is None:
        source = open_mask_source(place, names, mask_format, progress)
    else:
        source, of_names = paired(names, lambda asked: open_mask_source(place, asked, mask_format, progress), pictured)
        placed, of_pictures = placements(source, pictured)
        inferred = (*of_names, *of_pictures)
    choice = find_class_choice(classes, place if place.is_dir() else place.parent)
    source, choice, of_numbers = numbered(source, choice, place)
    number_of: Mapping[int, int] = {}
    more: tuple[ClassLabel, ...] = ()
    of_detections: tuple[Inferred, ...] = ()
    if detections is not None:
        labels = (choice and choice.labels) or source.labels or ()
        detections, of_detections = fitted(detections, source, labels)
        number_of, more = detections.joined(labels)
    known = class_map(source.labels, choice, place, source.tells_no_class, more)
    fuses = source.stuff_in_pieces or known.merges
    table = source.table if choice is None else "the class table"
    others = "" if choice is None else other_numberings(choice)
    readers = {
        name: MaskReader(mask, known, source.void, fuses, table, others, placed.get(name))
        for name, mask in source.masks.items()
    }
    warnings, paths = [*source.warnings], {name: mask.path for name, mask in source.masks.items()}
    files = {name: f"{path.parent.name}/{path.name}" for name, path in paths.items()}
    others_named = [f"{name} has {file}" for name, file in files.items() if name not in file]
    if others_named and len({*paths.values()}) == len(paths):  # else one file serves several frames
        warnings.append(f"masks are not named like their frames (do they belong together?): {listed(others_named, 2)}")
    over = {}
    if detections is not None:
        warnings += detections.warnings
        placed_apart = [name for name in detections.found if placed.get(name, Placement()) != Placement()]
        if placed_apart:
            what = f"masks were turned, cut or undistorted to fit ({listed(placed_apart)}), which detections cannot be"
            fix = "Give masks and detections that fit the stored pictures, or no detections."
            raise PlgsError("detections-placed", what, detections.path, fix, option="--detections")
        if more:
            join = f"to join one with a class of the masks, give it a [[class]] with name and into in {FILE_NAME}"
            warnings.append(f"detections have classes that the masks lack: {listed(one.name for one in more)}; {join}")
        over = {
            name: EvidenceReader(detections.path, detections.sizes[name], found, number_of, known)
            for name, found in detections.found.items()
            if name in readers
        }
    return MaskSet(known.classes, readers, tuple(warnings), (*inferred, *of_numbers, *of_detections), over)


def open_mask_source(place: Path, names: Sequence[str], mask_format: str | None, progress: Progress) -> MaskSource:
    """Open masks as they are stored, without the user's class table. Raises PlgsError for none that a reader knows."""
    reader = find_mask_format(place, mask_format)
    with reading(place, "Check that it exists, and its permissions."):
        return reader.read(place, names, progress)
