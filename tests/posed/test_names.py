"""No two names that we make are one for Cryptomatte, for a disk, or for OpenUSD."""

from __future__ import annotations

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from engine.posed import names
from engine.posed.names import matte_names, unique_names

PARTS = st.sampled_from(
    ["chair", "Chair", "ch\N{LATIN SMALL LETTER SHARP S}", "chss", " #1", " #3", " #12", "_2", ",", " "]
)
NAMES = st.dictionaries(st.integers(1, 20), st.lists(PARTS, max_size=4).map("".join), max_size=12)


@given(NAMES, st.sampled_from([" #", "_"]), st.integers(2, 32))
@example({1: "chair", 2: "Chair", 3: "chair #1"}, " #", 32)
def test_names_are_unique(given_names: dict[int, str], mark: str, bits: int) -> None:
    """The matte's number has so few bits here that names share it often."""
    with pytest.MonkeyPatch.context() as patch:
        exact = names.name_bits
        patch.setattr(names, "name_bits", lambda name: exact(name) % (1 << max(bits, 8)))
        unique = unique_names(given_names, mark)
        numbers = {names.name_bits(name) for name in unique.values()}
    assert [*unique] == [*given_names]
    assert len(numbers) == len({name.casefold() for name in unique.values()}) == len(given_names)
    assert all(unique[key].startswith(name) for key, name in given_names.items())
    folded = [name.casefold() for name in given_names.values()]
    if bits == 32:
        assert all(unique[key] == name for key, name in given_names.items() if folded.count(name.casefold()) == 1)


def test_names_keep_what_they_can() -> None:
    given_names = {1: "chair 1", 2: 'a "b", c', 3: "Chair 1", 4: ",", 5: "T\u00fcr", 6: "Tu\u0308r", 7: "desk"}
    assert matte_names(given_names) == {
        1: "chair 1 #1", 2: "a b c", 3: "Chair 1 #3", 4: "id 4", 5: "T\u00fcr #5", 6: "Tu\u0308r #6", 7: "desk",
    }  # fmt: skip
