"""Read and write dataclasses ("records") as JSON files, checked against their annotations. A field is a text, a number,
true or false, a path, a Literal, a tuple, a mapping from texts, another record, Json, or a union of these. A field with
a default may be absent, and is left out when both it and the default are empty. Its metadata says more: ``least`` and
``most`` bound its numbers, ``longest`` its text, ``shown`` makes its text fit for one line, ``inside`` says that its
path leads into the folder of the file, and ``apart`` that it is not in the file."""

from __future__ import annotations

import math
import unicodedata
from collections.abc import Mapping
from dataclasses import MISSING, Field, fields, is_dataclass
from functools import cache
from pathlib import Path, PurePosixPath
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from .errors import PlgsError
from .gates import inner_path, one_line
from .json_file import read_object, shown_json, to_text

Record = TypeVar("Record")
_NAMES = {str: "a text", Path: "a path", PurePosixPath: "a path", bool: "true or false", NoneType: "null"}
_MOST_LISTED = 8  # keys that a message lists


def to_json(record: Any, folder: Path | None = None) -> dict[str, Any]:
    """Return a record's fields as a JSON object. Paths with the metadata ``inside`` become relative to ``folder``."""
    content: dict[str, Any] = {}
    for each in fields(record):
        value = getattr(record, each.name)
        if each.metadata.get("apart") or (not value and value == _default(each)):
            continue
        if each.metadata.get("inside") and value is not None:
            assert folder is not None
            value = value.relative_to(folder).as_posix()
        content[each.name] = _plain(value, folder)
    return content


def record_text(record: Any, folder: Path | None = None, version: int = 1) -> str:
    """Return the JSON text of a record, for a file in ``folder`` that `read_record` reads with the same ``version``."""
    return to_text({"format": version, **to_json(record, folder)})


def read_record(kind: type[Record], path: Path, fix: str, version: int = 1, **apart: Any) -> Record:
    """Read a record of the class ``kind`` from a file of ours in the format ``version``. ``apart`` gives the fields
    that are not in the file. ``fix`` is the advice in the PlgsError that is raised for other content."""
    content: dict[str, Any] = read_object(path, fix)
    refuse_other_format(content, path, version)
    return record_of(kind, content, path, fix, **apart)


def refuse_other_format(content: dict[str, Any], path: Path | str, version: int = 1) -> None:
    """Remove the format number from a file's content. Raises PlgsError if it is not ``version``."""
    found = content.pop("format", None)
    if found != version or isinstance(found, bool):
        what = f"the file has format {found!r}, but this version reads {version}"
        raise PlgsError("other-format", what, path, "Use the version of PLGS that wrote it.")


def record_of(
    kind: type[Record], content: Mapping[str, Any], path: Path | str, fix: str, context: str = "", **apart: Any
) -> Record:
    """Return the record of the class ``kind`` from ``content``, a JSON object of the file ``path``, at ``context`` in
    it ("files[3]"; "" for all of it). ``apart`` are values of fields that are not in ``content``. Other content raises
    a PlgsError that names the key and the expected value, with ``fix`` as the advice."""
    declared, hints = _declared(cast(Any, kind)), _hints(cast(Any, kind))
    if unknown := sorted(content.keys() - declared.keys()):
        where = f" in {context}" if context else ""
        what = f"the file has {', '.join(map(repr, unknown))}{where}, which this version does not know"
        known = f" This one knows {', '.join(declared)}." if len(declared) <= _MOST_LISTED else ""
        fix = f"Remove it, or use the version of PLGS that wrote it.{known}"
        raise PlgsError("unknown-field", what, path, fix)
    values = dict(apart)
    for name, each in declared.items():
        key = f"{context}.{name}" if context else name
        if name in content:
            given = content[name]
            usual = type(given) is str and hints[name] is str and given.isprintable() and "longest" not in each.metadata
            values[name] = given if usual else _Reader(path, fix, each.metadata).value(hints[name], given, key)
        elif each.default is MISSING and each.default_factory is MISSING:
            raise PlgsError("lacks-field", f"the file has no '{key}'", path, fix)
    try:
        return kind(**values)
    except ValueError as error:
        raise PlgsError("bad-record", f"{context or 'the file'}: {error}", path, fix) from error


def check_record(record: Any, fix: str) -> None:
    """Raise PlgsError, with ``fix`` as the advice, if a field's value is not as its annotation and metadata say."""
    hints = _hints(cast(Any, type(record)))
    for each in _declared(cast(Any, type(record))).values():
        value = getattr(record, each.name)
        given = str(value) if isinstance(value, Path) else _plain(value, None)
        _Reader("", fix, each.metadata).value(hints[each.name], given, each.name)


class _Reader:
    """Converts JSON values of one file to the types that a record's annotations name."""

    def __init__(self, path: Path | str, fix: str, more: Mapping[str, Any]) -> None:
        self._path, self._fix, self._more = path, fix, more
        self._least, self._most = more.get("least", -math.inf), more.get("most", math.inf)

    def value(self, kind: Any, given: Any, key: str) -> Any:
        origin, inner = _parts(kind)
        if origin is Any:
            return given
        if origin is Union:
            return self._one_of(inner, given, key)
        if origin is _RECORD and isinstance(given, dict):
            return record_of(kind, given, self._path, self._fix, key)
        if origin is tuple and isinstance(given, list):
            return self._tuple(kind, inner, given, key)
        if origin not in (None, tuple, Literal, _RECORD) and isinstance(given, dict):
            return {name: self.value(inner[1], each, f"{key}[{name!r}]") for name, each in given.items()}
        found = self._simple(kind, given, key)
        if found is None and kind is not NoneType:
            raise self.wrong(kind, given, key)
        return found

    def _one_of(self, kinds: tuple[Any, ...], given: Any, key: str) -> Any:
        """Convert ``given`` to the first of ``kinds`` that fits. If none fits, the last one's error is raised."""
        kinds = tuple(each for each in kinds if (each is NoneType) == (given is None))
        for each in kinds[:-1]:
            try:
                return self.value(each, given, key)
            except PlgsError:
                continue
        if not kinds:
            raise PlgsError("field-null", f"'{key}' must not be null", self._path, self._fix)
        return self.value(kinds[-1], given, key)

    def _tuple(self, kind: Any, inner: tuple[Any, ...], given: list[Any], key: str) -> Any:
        if inner[-1] is not Ellipsis and len(given) != len(inner):
            raise self.wrong(kind, given, key)
        least, most, exact = max(self._least, -1e300), min(self._most, 1e300), inner[0]
        are_alike = exact in (int, float) and not {*inner} - {exact, Ellipsis}
        if are_alike and all(type(each) is exact and least <= each <= most for each in given):
            return tuple(given)  # there may be millions
        kinds = inner[:1] * len(given) if inner[-1] is Ellipsis else inner
        return tuple(
            self.value(each, value, f"{key}[{i}]") for i, (each, value) in enumerate(zip(kinds, given, strict=True))
        )

    def _simple(self, kind: Any, given: Any, key: str) -> Any:
        """Convert ``given`` to a simple type; None if ``kind`` is not a simple type."""
        if get_origin(kind) is Literal:
            return given if isinstance(given, str) and given in get_args(kind) else None
        if kind in (int, float):
            return self._number(kind, given)
        if kind is bool:
            return given if isinstance(given, bool) else None
        if not isinstance(given, str) or (kind is str and len(given) > self._more.get("longest", math.inf)):
            return None
        if kind is PurePosixPath or self._more.get("inside"):
            return self._inner(kind, given, key)
        if kind is Path:
            return Path(given)
        if any(unicodedata.category(character) in ("Cc", "Cs") for character in given):
            raise PlgsError("bad-characters", f"'{key}' has characters that names cannot have", self._path, self._fix)
        return (one_line(given) if self._more.get("shown") else given) if kind is str else None

    def _inner(self, kind: Any, given: str, key: str) -> Path | PurePosixPath:
        try:
            inside = inner_path(given)
        except ValueError as error:
            raise PlgsError("bad-field", f"'{key}': {error}", self._path, self._fix) from error
        return Path(self._path).parent / inside if kind is Path else inside

    def _number(self, kind: Any, given: Any) -> int | float | None:
        if isinstance(given, bool) or not isinstance(given, int | float) or not self._least <= given <= self._most:
            return None
        if kind is int:
            return int(given) if isinstance(given, int) or given.is_integer() else None
        return float(given) if abs(given) < 1e300 else None

    def wrong(self, kind: Any, given: Any, key: str) -> PlgsError:
        """Return the error for a value that is not of the type ``kind``."""
        what = f"'{key}' must be {self._words(kind)}, not {shown_json(given)}"
        return PlgsError("wrong-type", what, self._path, self._fix)

    def _words(self, kind: Any) -> str:
        if get_origin(kind) is Literal:
            return f"one of {', '.join(get_args(kind))}"
        if get_origin(kind) is tuple:
            inner = get_args(kind)
            return "a list" if inner[-1] is Ellipsis else f"a list of {len(inner)}"
        if kind not in (int, float):
            longest = f" of at most {self._more['longest']} characters" if "longest" in self._more else ""
            return _NAMES.get(kind, "an object") + longest
        least = "" if math.isinf(self._least) else f" from {self._least:.15g}"
        most = "" if math.isinf(self._most) else f" to {self._most:.15g}"
        return ("a whole number" if kind is int else "a number") + least + most


@cache
def _declared(kind: Any) -> dict[str, Field[Any]]:
    """The fields of a record that its JSON holds, by name."""
    return {each.name: each for each in fields(kind) if not each.metadata.get("apart")}


def _default(declared: Field[Any]) -> Any:
    if declared.default is not MISSING:
        return declared.default
    return MISSING if declared.default_factory is MISSING else declared.default_factory()


_RECORD = "record"


@cache
def _parts(kind: Any) -> tuple[Any, tuple[Any, ...]]:
    """Return the origin of an annotation, such as tuple or Union (Any for Json, too), and the annotations inside it."""
    origin, inner = get_origin(kind), get_args(kind)
    if kind is Any or {list, dict} <= {get_origin(each) for each in inner}:
        return Any, ()
    if origin in (Union, UnionType):
        return Union, inner
    return (_RECORD if is_dataclass(kind) else origin), inner


@cache
def _hints(kind: Any) -> dict[str, Any]:
    return get_type_hints(kind)


def _plain(value: Any, folder: Path | None) -> Any:
    if is_dataclass(value):
        return to_json(value, folder)
    if isinstance(value, Mapping):
        return {name: _plain(each, folder) for name, each in value.items()}
    if isinstance(value, tuple) and any(is_dataclass(each) for each in value[:1]):
        return [_plain(each, folder) for each in value]
    return value
