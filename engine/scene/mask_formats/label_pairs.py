"""Two folders of label images, one of classes and one of instances; or one of classes alone, as palette or grey PNGs.

The values are the class's number in a table that the user names (``--classes``, ``classes.toml``). 0, 255 and 65535
mean nothing unless the table has them. Instance 0 is none: such a region may be several objects.

Panoptic Lifting's network masks are folders ``<prefix>_semantics`` and ``<prefix>_instance`` of label images. Of two
sets, that with test-time augmentation (``m2f_``) is preferred to ``m2f_notta_``, as that project's readers load it; the
paper seems to use the other. A warning says how to choose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

from ...errors import PlgsError
from ...job.progress import part_of, unwatched
from ...posed.layout import shown_size
from ..class_tables import REDUCED, known_table
from ..files_of_frames import files_of_both, files_of_frames, mask_files
from ..pixels import SUFFIXES, check_label_header, label_map_size, read_label_map
from ..values import numbers_of_colours
from ..view import Progress, watched
from .source import IGNORED, FoundMask, MaskFormat, MaskSource, StoredMask, segments_of_labels, segments_of_pairs

PAIRS = (
    ("semantic", "instance"),
    ("semantics", "instances"),
    ("semantic_class", "semantic_instance"),
    ("class", "instance"),
    ("classes", "instances"),
    ("label-filt", "instance-filt"),
    ("label", "instance"),
)
"""Names of the folders of classes and of instances."""
_LOOKS_FOR = "folders semantic and instance (or class, label-filt, semantic_class and theirs)"
_FIX = "Give a label image for every frame, with the frame's name."


def _pair_in(place: Path) -> tuple[Path, Path] | None:
    pairs = ((place / classes, place / instances) for classes, instances in PAIRS)
    return next((pair for pair in pairs if pair[0].is_dir() and pair[1].is_dir()), None)


def _read_pairs(place: Path, names: Sequence[str], progress: Progress) -> MaskSource:
    pair = _pair_in(place)
    if pair is None:
        what = "there are no paired folders of classes and instances"
        raise PlgsError("no-label-pair", what, place, f"Looked for {_LOOKS_FOR}.")
    classes, instances = files_of_both(*pair, names, suffixes=SUFFIXES, fix=_FIX, progress=part_of(progress, 0.0, 0.5))
    return MaskSource(label_pairs(classes, instances, part_of(progress, 0.5, 1.0)), void=IGNORED)


def label_pairs(
    classes: Mapping[str, Path], instances: Mapping[str, Path], progress: Progress = unwatched
) -> dict[str, StoredMask]:
    """Make masks from each frame's image of ``classes`` and, if there are any, of ``instances``. Raises PlgsError if
    the images of a frame differ in size or hold no ids."""
    masks = {}
    for name, path in watched([*classes.items()], progress):
        size, instance = label_map_size(path), instances.get(name)
        if instance is not None and label_map_size(instance) != size:
            what = f"the instance image is not {shown_size(size)} like the classes"
            raise PlgsError("other-size", what, instance, "Make both the same size.")
        masks[name] = StoredMask(path, size, partial(_read_pair, path, instance))
    numbers_of_colours([path for path in classes.values() if path.suffix.lower() == ".png"], is_class=True)
    return masks


def _read_pair(classes: Path, instances: Path | None) -> FoundMask:
    labels = read_label_map(classes)
    if instances is None:
        return segments_of_labels(labels)
    objects = read_label_map(instances)
    if labels.shape != objects.shape:
        what = "the instance image has another size"
        raise PlgsError("other-size", what, instances, "Make it as large as the classes.")
    return segments_of_pairs(labels, objects)


PAIRS_FORMAT = MaskFormat("pairs", lambda place: _pair_in(place) is not None, _read_pairs, own_names=True)
PALETTE = MaskFormat(
    "palette",
    lambda place: not mask_files(place, ".json") and bool(mask_files(place, ".png")),
    lambda place, names, progress: MaskSource(
        label_pairs(files_of_frames(place, names, {".png"}, what="mask", fix=_FIX, progress=progress), {}), void=IGNORED
    ),
)


_LIFTING_FIX = "Panoptic Lifting's masks are the folders m2f_semantics and m2f_instance."
_BOTH = "masks with test-time augmentation are used; for those without, name m2f_notta_semantics as the masks"


def _semantics_of(place: Path) -> Path | None:
    """Return the folder of class images: ``place`` itself or a subfolder; None without one."""
    if place.name.endswith("_semantics"):
        return place if place.is_dir() else None
    return next((each for each in (place / "m2f_semantics", place / "m2f_notta_semantics") if each.is_dir()), None)


def _read_lifting(place: Path, names: Sequence[str], progress: Progress) -> MaskSource:
    """Open ``<prefix>_semantics`` and the ``<prefix>_instance`` beside it."""
    semantics = _semantics_of(place)
    if semantics is None:
        raise PlgsError("no-masks", "there are no masks", place, _LIFTING_FIX)
    instances = semantics.with_name(semantics.name.removesuffix("_semantics") + "_instance")
    fix = "Add PNGs named like the colour images."
    of_files, of_headers = part_of(progress, 0.0, 0.3), part_of(progress, 0.3, 0.6)
    semantic_files, instance_files = files_of_both(
        semantics, instances, names, suffixes={".png"}, fix=fix, progress=of_files
    )
    for name in watched([*semantic_files], of_headers):
        check_label_header(semantic_files[name])
        check_label_header(instance_files[name])
    has_both = semantics != place and semantics.name == "m2f_semantics" and (place / "m2f_notta_semantics").is_dir()
    return MaskSource(
        label_pairs(semantic_files, instance_files, part_of(progress, 0.6, 1.0)),
        labels=known_table(REDUCED).labels,
        warnings=(_BOTH,) if has_both else (),
        table="Panoptic Lifting's reduced table (0 to 21)",
    )


PANOPTIC_LIFTING = MaskFormat(
    "panoptic-lifting", lambda place: _semantics_of(place) is not None, _read_lifting, in_scene=True, own_names=True
)
