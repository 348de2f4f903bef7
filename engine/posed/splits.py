"""Which frames are trained on and which are held out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ..errors import PlgsError
from ..json_file import read_json_object, take_list, wrong_type
from .layout import listed, plural

NOTHING_MEASURED = "no frame is held out: nothing is measured on unseen views"
_EVERY, _FIRST = 8, 4
"""Every 8th frame is held out, starting with the 5th."""
_MOST = 40
"""The largest number of held-out frames. More measure nothing better, and each is rendered and scored."""


@dataclass(frozen=True)
class Split:
    """Frame names of each part, in recording order, and warnings."""

    train: tuple[str, ...]
    test: tuple[str, ...]
    warnings: tuple[str, ...] = ()


def find_split(folder: Path, names: Sequence[str], lost: Sequence[str]) -> Split:
    """The split of the frames ``names`` by ``splits.json`` in ``folder``, or the default without that file.

    ``lost`` names frames without a pose. Raises PlgsError as ``read_split`` does, or when no frame is left to train on.
    """
    table = folder / "splits.json"
    split = read_split(table, names, lost) if table.is_file() else default_split(names)
    if not split.train:
        raise PlgsError("there is no frame to train on", table, "Name frames in train.")
    return split


def default_split(names: Sequence[str]) -> Split:
    """Hold out every 8th frame: the 5th, the 13th, ..., at most 40. Fewer than five frames are all trained on.

    The first frame, and often the last, shows most that no other does, so they are trained on.
    """
    every = max(_EVERY, -(-len(names) // _MOST))
    test = names[_FIRST::every]
    train = tuple(name for index, name in enumerate(names) if index % every != _FIRST)
    warnings = () if test else ("there are too few frames to hold one out: nothing is measured on unseen views",)
    return Split(train, tuple(test), warnings)


def read_split(path: Path, names: Sequence[str], dropped: Sequence[str]) -> Split:
    """Read ``splits.json``: {"train": [...], "test": [...]} with stems of colour images.

    Names in ``dropped`` (frames without a pose) are skipped. Raises PlgsError for unknown names, and for
    names that are in both lists or twice in one.
    """
    content = read_json_object(path)
    parts: dict[str, set[str]] = {}
    for key in ("train", "test"):
        listed_names = take_list(content, key, "the file", path)
        for name in listed_names:
            if not isinstance(name, str):
                raise wrong_type(key, "a list of frame names", name, "the file", path)
        parts[key] = {*listed_names}
        if len(parts[key]) < len(listed_names):
            twice = sorted({name for name in listed_names if listed_names.count(name) > 1})
            raise PlgsError(f'"{key}" names frames twice ({listed(twice)})', path, "Name each frame once.")
    unknown = sorted((parts["train"] | parts["test"]) - {*names} - {*dropped})
    if unknown:
        fix = "Delete these names or the file; a name is the colour image's without suffix."
        raise PlgsError(f"frames that do not exist are named ({listed(unknown)})", path, fix)
    both = sorted(parts["train"] & parts["test"])
    if both:
        raise PlgsError(f"frames are in train and in test ({listed(both)})", path, "Put each in one of the two.")
    chosen = parts["train"] | parts["test"]
    left_out = [name for name in names if name not in chosen]
    some = plural(len(left_out), "frame is", "frames are")
    warnings = [f"{some} left out by splits.json: {listed(left_out)}"] if left_out else []
    train, test = (tuple(name for name in names if name in parts[key]) for key in ("train", "test"))
    return Split(train, test, tuple(warnings if test else [*warnings, NOTHING_MEASURED]))
