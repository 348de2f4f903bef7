"""How long files are fuzzed. PLGS_FUZZ=100 makes a hundred times as many examples: for an hour by hand."""

import copy
import os
from collections.abc import Iterable
from typing import Any

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

FACTOR = int(os.environ.get("PLGS_FUZZ", "1"))
ODD_VALUES = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=8),
    st.lists(st.integers(-1, 300), max_size=3), st.dictionaries(st.text(max_size=3), st.integers(), max_size=2),
    st.sampled_from(["../x", "\\\\host\\x", "\0", "\x1b[2J", 1e308, 2**31, 2**63, 10**400, -1, 0, "a" * 5000, [[[]]]]),
)  # fmt: skip


def examples(count: int) -> settings:
    """For a test that looks at so many spoilt files as a rule."""
    health = [HealthCheck.function_scoped_fixture, HealthCheck.too_slow, HealthCheck.data_too_large]
    return settings(max_examples=count * FACTOR, deadline=None, suppress_health_check=health, database=None)


def places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The way to every value inside a JSON document."""
    found = [path]
    items: Iterable[tuple[Any, Any]] = ()
    if isinstance(value, dict):
        items = value.items()
    elif isinstance(value, list):
        items = enumerate(value)
    for key, item in items:
        found += places(item, (*path, key))
    return found


def with_odd_value(draw: Any, content: Any) -> Any:
    """A JSON document with another value, or none, at one of its places. The document itself is changed."""
    path = draw(st.sampled_from(places(content)))
    odd = copy.deepcopy(draw(ODD_VALUES))  # for the next change may be one inside it, and it is drawn again
    if not path:
        return odd
    holder = content
    for key in path[:-1]:
        holder = holder[key]
    if draw(st.booleans()):
        holder[path[-1]] = odd
    else:
        del holder[path[-1]]
    return content


def damaged(draw: Any, data: bytes) -> bytes:
    """Bytes with some of them changed, cut off, doubled or taken out."""
    place = draw(st.integers(0, max(0, len(data) - 1)))
    length = draw(st.integers(1, 64))
    match draw(st.sampled_from(["change", "cut off", "double", "take out", "zeros"])):
        case "change":
            return data[:place] + draw(st.binary(min_size=1, max_size=8)) + data[place + length :]
        case "cut off":
            return data[:place]
        case "double":
            return data[:place] + data[place : place + length] * 2 + data[place + length :]
        case "take out":
            return data[:place] + data[place + length :]
    return data[:place] + bytes(length) + data[place + length :]
