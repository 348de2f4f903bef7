"""Soft coverage as ranks, hashes against published values, names that Blender can take."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from engine.passes import cryptomatte
from tests.passes.views import CLASSES, EDGE, LEFT, NAMES, NOTHING, RIGHT, made_rendering


@pytest.mark.parametrize(
    ("text", "seed", "expected"),
    [("", 0, 0), ("", 1, 0x514E28B7), ("test", 0, 0xBA6BD213), ("Hello, world!", 0, 0xC0363E43)],
)
def test_hash(text: str, seed: int, expected: int) -> None:
    assert cryptomatte.murmur3(text.encode(), seed) == expected


def test_instances_get_no_more_than_things_cover() -> None:
    coverage = cryptomatte.instance_coverage(made_rendering(), CLASSES, NAMES)
    assert coverage["chair 1"][LEFT] == pytest.approx(1.0)
    assert coverage["chair 1"][EDGE] == pytest.approx(0.6)
    assert coverage["chair 2"][EDGE] == pytest.approx(0.0, abs=1e-6)
    assert coverage["chair 2"][RIGHT] == pytest.approx(1.0)
    assert not coverage["chair 2"][0, 3:5].any()


def test_ranks() -> None:
    rendering = made_rendering()
    coverage = cryptomatte.class_coverage(rendering, CLASSES)
    assert list(coverage) == ["wall", "chair", "sofa long"]
    channels = cryptomatte.channels("CryptoClass", coverage, rendering.alpha)
    assert len(channels) == 12
    assert channels["CryptoClass00.r"][0, 2] == np.float32(cryptomatte.name_float("chair"))
    assert channels["CryptoClass00.g"][0, 2] == pytest.approx(0.6)
    assert channels["CryptoClass00.b"][0, 2] == np.float32(cryptomatte.name_float("wall"))
    assert channels["CryptoClass00.a"][0, 2] == pytest.approx(0.4)
    assert not any(values[NOTHING].any() for values in channels.values())


@settings(deadline=None)
@given(arrays(np.float32, (2, 3, 9), elements=st.floats(0, 1, width=32)))
def test_ranks_descend_and_sum_to_one_at_most(stack: np.ndarray) -> None:
    coverage = {f"thing {k}": stack[..., k] for k in range(9)}
    channels = cryptomatte.channels("L", coverage, np.ones((2, 3), np.float32))
    ranks = np.stack([channels[f"L0{r // 2}.{'ga'[r % 2]}"] for r in range(6)])
    assert (np.diff(ranks, axis=0) <= 0).all()
    assert ranks.sum(axis=0).max() <= 1 + 1e-5


def test_names() -> None:
    names = cryptomatte.matte_names({1: "chair 1", 2: 'a "b", c', 3: "chair 1", 4: ",", 5: "Tür"})
    assert names == {1: "chair 1 #1", 2: "a b c", 3: "chair 1 #3", 4: "id 4", 5: "Tür"}


def test_header() -> None:
    header = cryptomatte.header("CryptoInstance", ["chair 1", "Tür"])
    (manifest,) = [value for key, value in header.items() if key.endswith("/manifest")]
    assert json.loads(manifest)["chair 1"] == f"{cryptomatte.name_bits('chair 1'):08x}"
    assert all(key.startswith("cryptomatte/") and len(key.split("/")[1]) == 7 for key in header)


@settings(deadline=None)
@given(st.text())
def test_names_become_ordinary_floats(name: str) -> None:
    if name.isprintable():
        assert np.isfinite(cryptomatte.name_float(name))
        assert abs(cryptomatte.name_float(name)) >= np.finfo(np.float32).tiny
