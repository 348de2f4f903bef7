"""Whatever stands in a sample's files, opening and looking into it either works or raises PlgsError with one line."""

from __future__ import annotations

import json
import re
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from engine.errors import PlgsError
from tests.fuzzing import damaged, examples, with_odd_value
from tests.scene.formats.test_record3d import lzfse  # noqa: F401 - a fixture
from tests.scene.samples import WRITERS, Sample, look_into, samples, with_content  # noqa: F401 - a fixture among them

ODD_WORDS = ("nan", "-inf", "1e999", "x", "", "-1", "0", "99999999999999999999", "../a", "\0")


def odd_word(draw: Any, data: bytes) -> bytes:
    """One number of a text is another word."""
    found = [*re.finditer(rb"-?\d[\d.e+-]*", data)]
    place = draw(st.sampled_from(found)) if found else None
    word = draw(st.sampled_from(ODD_WORDS)).encode()
    return b"" if place is None else data[: place.start()] + word + data[place.end() :]


def odd_value(draw: Any, data: bytes) -> bytes:
    """One value of a JSON document is another; other files are damaged."""
    try:
        return json.dumps(with_odd_value(draw, json.loads(data))).encode()
    except ValueError:
        return damaged(draw, data)


@pytest.mark.parametrize("name", WRITERS)
@examples(8)
@given(data=st.data())
def test_damaged_samples_are_one_line_errors(sample: Sample, name: str, data: st.DataObject) -> None:
    files = sorted(path for path in sample(name).rglob("*") if path.is_file())
    suffix = data.draw(st.sampled_from(sorted({path.suffix for path in files})))  # what kind a file is of
    path = data.draw(st.sampled_from([path for path in files if path.suffix == suffix]))
    spoil = data.draw(st.sampled_from([damaged, odd_word, odd_value]))
    with with_content(path, spoil(data.draw, path.read_bytes())):
        try:
            look_into(sample(name), name)
        except PlgsError as error:
            assert "\n" not in str(error) and error.fix.endswith((".", "?")), str(error)
