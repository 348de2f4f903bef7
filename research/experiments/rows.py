"""The rows of the tables as data: rows.toml, read and checked."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from engine.errors import PlgsError, did_you_mean
from engine.json_file import Json
from engine.presets.options import checked_options

ROWS = Path(__file__).with_suffix(".toml")
_FIX = "Fix rows.toml."


@dataclass(frozen=True)
class Cited:
    """The paper's figures for a row, in per cent and decibels, for the scenes of ``dataset``."""

    dataset: str
    miou: float | None = None
    pq: float | None = None
    psnr: float | None = None
    note: str = ""


@dataclass(frozen=True)
class Row:
    """A row of a table. It is a lift with ``options`` changed, with the scene's file ``masks`` instead of the usual
    ones, or with the depth that the lift of the row ``depth_from`` renders instead of the sensor's. Or it is
    ``method``, which needs no lift; ``same_as``, the lift of another row; or, if ``is_cited``, the paper's figures."""

    name: str
    table: str
    options: Mapping[str, Json] = field(default_factory=dict)
    method: str | None = None
    same_as: str | None = None
    masks: str | None = None
    depth_from: str | None = None
    paper: Cited | None = None
    is_cited: bool = False

    @property
    def is_lift(self) -> bool:
        return not (self.is_cited or self.method or self.same_as)

    @property
    def measured_as(self) -> str:
        """The name under which the row's results are stored."""
        return f"{self.method}, {self.masks}" if self.method and self.masks else self.method or self.name

    @property
    def slug(self) -> str:
        """The row's name in the names of folders."""
        return re.sub(r"\W+", "-", self.name.lower()).strip("-")


@dataclass(frozen=True)
class Rows:
    """All rows in their order, and the headings of their tables."""

    rows: tuple[Row, ...]
    tables: Mapping[str, str]

    def named(self, name: str) -> Row:
        """Return the row with this name. Raises StopIteration if there is none."""
        return next(row for row in self.rows if row.name == name)

    def lift_of(self, row: Row) -> Row:
        """Return the row whose lift this one shows: itself, or that of ``same_as``."""
        return self.named(row.same_as) if row.same_as else row

    def listed(self) -> Iterator[str]:
        """Yield a line for each table's heading and for each of its rows."""
        for table, heading in self.tables.items():
            yield f"{table}: {heading}"
            yield from (f"    {row.name}" for row in self.rows if row.table == table and not row.is_cited)

    def chosen(self, only: Sequence[str]) -> tuple[Row, ...]:
        """Return the rows with these names, or in tables with these names; all rows without any. Raises PlgsError,
        which suggests the closest name."""
        known = {name.casefold(): name for name in (*self.tables, *(row.name for row in self.rows))}
        for wanted in only:
            if wanted.casefold() not in known:
                hint = did_you_mean(wanted.casefold(), known, 0.4)
                fix = f"{hint}There are the tables {', '.join(self.tables)} and their rows, see rows.toml."
                raise PlgsError("no-row", "no row or table has this name", wanted, fix)
        names = {wanted.casefold() for wanted in only}
        return tuple(row for row in self.rows if not only or {row.name.casefold(), row.table.casefold()} & names)


def read_rows(path: Path = ROWS) -> Rows:
    """Read the rows in a file. Raises PlgsError if it holds none."""
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
        rows = tuple(_rows(content))
        found = Rows(rows, content["tables"])
        for row in rows:
            others = [found.named(name) for name in (row.same_as, row.depth_from) if name]
            if row.table not in found.tables or not all(other.is_lift for other in others):
                raise KeyError(row.name)
    except (OSError, ValueError, KeyError, TypeError, StopIteration) as error:
        raise PlgsError("not-rows", f"is not a table of rows ({error!r})", path, _FIX) from error
    if len({row.slug for row in rows}) != len(rows):
        raise PlgsError("row-twice", "two rows have the same name", path, _FIX)
    return found


def _rows(content: Mapping[str, Any]) -> Iterator[Row]:
    for kind in ("row", "cited"):
        for entry in content.get(kind, ()):
            own = {key: value for key, value in entry.items() if key not in ("set", "way", "paper")}
            options = {**_way(content, entry.get("way")), **entry.get("set", {})}
            paper = Cited(**entry["paper"]) if "paper" in entry else None
            yield Row(**own, options=checked_options(options), paper=paper, is_cited=kind == "cited")


def _way(content: Mapping[str, Any], name: str | None) -> dict[str, Any]:
    if name is None:
        return {}
    own = dict(content["ways"][name])
    return {**_way(content, own.pop("way", None)), **own}
