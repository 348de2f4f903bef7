"""Classes, and which of them are things (countable objects) or stuff (walls, floors)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from ..gates import one_line

LARGEST_ID = 65535  # maximum id of a class or instance, so that tables by id (palettes, 16-bit images) stay small
VOID = 0  # class id of pixels without a label; it is never predicted
LARGEST_CLASS_ID = LARGEST_ID - 1  # maximum class id in mask files: a table that uses 0 is shifted by one
_WORDS = Path(__file__).with_name("palette.txt").read_text("ascii").split()
PALETTE = tuple((red, green, blue) for red, green, blue in map(bytes.fromhex, _WORDS))
"""Colours, sRGB bytes: each as distant as possible from all before it (CIEDE2000)."""


@dataclass(frozen=True)
class ClassLabel:
    """A class with its number in the masks' own files, ``id``, which may be 0. A thing has instances, stuff has none.
    ``name`` is the file's, on one printable line, to be shown anywhere. ``colour`` is sRGB bytes or None."""

    id: int
    name: str
    is_thing: bool
    colour: tuple[int, int, int] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", one_line(self.name))


@dataclass(frozen=True)
class Category:
    """A class of a scene. ``id`` is at least 1; ``colour`` is three sRGB bytes; see ClassLabel for the other fields."""

    id: int
    name: str
    is_thing: bool
    colour: tuple[int, int, int]

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", one_line(self.name))


@dataclass(frozen=True)
class ClassTable:
    """The classes of a scene in ascending order of id; void is not among them."""

    categories: tuple[Category, ...]

    def __post_init__(self) -> None:
        if list(self.ids) != sorted(set(self.ids)) or any(class_id <= VOID for class_id in self.ids):
            raise ValueError("class ids must be unique, ascending and greater than 0")

    @property
    def ids(self) -> tuple[int, ...]:
        return tuple(category.id for category in self.categories)

    @property
    def thing_ids(self) -> frozenset[int]:
        return frozenset(category.id for category in self.categories if category.is_thing)

    @cached_property
    def _by_id(self) -> dict[int, Category]:
        return {category.id: category for category in self.categories}

    def __getitem__(self, class_id: int) -> Category:
        """The category of an id; KeyError if the table lacks it."""
        return self._by_id[class_id]

    def __contains__(self, class_id: int) -> bool:
        return class_id in self._by_id

    def __len__(self) -> int:
        return len(self.categories)


def distinct_colour(instance: int) -> tuple[int, int, int]:
    """Return an instance's colour in PALETTE, from the 40th on, as the commonest classes have the first 40."""
    return PALETTE[(39 + instance) % len(PALETTE)]


def named(names: Mapping[int, str], text: str) -> list[int]:
    """Return the ids of the names equal to ``text``. If there are none, ignore upper and lower case."""
    exact = [key for key, name in names.items() if name == text]
    return exact or [key for key, name in names.items() if name.casefold() == text.casefold()]
