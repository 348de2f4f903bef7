"""Soft coverage as ranks, hashes against published values, names that Blender can take."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from engine.passes import cryptomatte
from engine.passes.baked_view import ShownInstances, bake_view
from engine.passes.cryptomatte import RANKS
from engine.passes.layers import STEPS
from engine.posed.classes import matte_names
from tests.passes.views import CHAIR, CLASSES, EDGE, LEFT, NAMES, NOTHING, RIGHT, WALL, made_rendering

LAYERS = ("CryptoInstance", "CryptoClass")
STEP = 0.5 / STEPS
"""What rounding changes at most."""


@pytest.mark.parametrize(
    ("text", "seed", "expected"),
    [("", 0, 0), ("", 1, 0x514E28B7), ("test", 0, 0xBA6BD213), ("Hello, world!", 0, 0xC0363E43)],
)
def test_the_hash_is_murmur3(text: str, seed: int, expected: int) -> None:
    assert cryptomatte.murmur3(text.encode(), seed) == expected


def mattes(instance_classes: dict[int, int] | None = None) -> dict[str, np.ndarray]:
    """Every rank channel of the rendering made by hand."""
    rendering = made_rendering()
    view = bake_view([rendering], rendering.camera, CLASSES, ShownInstances(NAMES, instance_classes))
    found: dict[str, np.ndarray] = {}
    for matte in view.mattes:
        found |= cryptomatte.channels(matte.layer.name, matte.ranks)
    return found


def coverage_of(found: dict[str, np.ndarray], layer: str, name: str) -> np.ndarray:
    """What a matte of this name pulls, float32 [H, W]."""
    bits = np.float32(cryptomatte.name_float(name))
    pairs = [(f"{layer}0{rank // 2}.{'rb'[rank % 2]}", f"{layer}0{rank // 2}.{'ga'[rank % 2]}") for rank in range(6)]
    return sum(np.where(found[ids] == bits, found[shares], 0) for ids, shares in pairs)


def test_instances_get_no_more_than_the_coverage_of_things() -> None:
    found = mattes()
    chair_1, chair_2 = (coverage_of(found, "CryptoInstance", name) for name in ("chair 1", "chair 2"))
    assert chair_1[LEFT] == pytest.approx(1.0, abs=STEP)
    assert chair_1[EDGE] == pytest.approx(0.6, abs=STEP)
    assert chair_2[EDGE] == pytest.approx(0.0, abs=1e-6)
    assert chair_2[RIGHT] == pytest.approx(1.0, abs=STEP)
    assert not chair_2[0, 3:5].any()


def test_an_object_of_one_class_has_its_own_coverage() -> None:
    found = mattes({3: CHAIR, 70001: WALL})
    assert coverage_of(found, "CryptoInstance", "chair 1")[EDGE] == pytest.approx(0.7, abs=STEP)
    assert not coverage_of(found, "CryptoInstance", "chair 2").any()  # what is stuff is not an object


def test_ranks() -> None:
    found = mattes()
    assert len(found) == 24
    assert found["CryptoClass00.r"][0, 2] == np.float32(cryptomatte.name_float("chair"))
    assert found["CryptoClass00.g"][0, 2] == pytest.approx(0.6, abs=STEP)
    assert found["CryptoClass00.b"][0, 2] == np.float32(cryptomatte.name_float("wall"))
    assert found["CryptoClass00.a"][0, 2] == pytest.approx(0.4, abs=STEP)
    assert not any(values[NOTHING].any() for values in found.values())


def test_ranks_sum_to_what_is_covered() -> None:
    found, rendering = mattes({3: CHAIR, 70001: CHAIR}), made_rendering()
    shares = {layer: sum(found[f"{layer}0{k}.{c}"] for k in range(3) for c in "ga") for layer in LAYERS}
    np.testing.assert_allclose(shares["CryptoClass"], rendering.alpha, atol=RANKS * STEP)
    np.testing.assert_allclose(shares["CryptoInstance"], rendering.instance_coverage.sum(axis=-1), atol=RANKS * STEP)
    for layer in LAYERS:
        falling = np.stack([found[f"{layer}0{k}.{c}"] for k in range(3) for c in "ga"])
        assert (np.diff(falling, axis=0) <= 0).all()  # the strongest first


def test_every_id_is_in_the_manifest_and_the_manifest_is_blenders() -> None:
    rendering = made_rendering()
    view = bake_view([rendering], rendering.camera, CLASSES, ShownInstances(NAMES, None))
    for matte in view.mattes:
        header = cryptomatte.header(matte.layer.name, matte.layer.names)
        (prefix,) = {key.rpartition("/")[0] for key in header}
        assert prefix == f"cryptomatte/{cryptomatte.murmur3(matte.layer.name.encode()):08x}"[:19]
        assert header[f"{prefix}/hash"] == "MurmurHash3_32" and header[f"{prefix}/name"] == matte.layer.name
        assert header[f"{prefix}/conversion"] == "uint32_to_float32"
        bits = {int(value, 16) for value in json.loads(header[f"{prefix}/manifest"]).values()}
        planes = cryptomatte.channels(matte.layer.name, matte.ranks)
        ids = np.concatenate([planes[f"{matte.layer.name}0{k}.{c}"].ravel() for k in range(3) for c in "rb"])
        assert set(ids[ids != 0].view(np.uint32).tolist()) <= bits


def test_matte_names_are_unique_and_printable() -> None:
    names = matte_names({1: "chair 1", 2: 'a "b", c', 3: "chair 1", 4: ",", 5: "Tür"})
    assert names == {1: "chair 1 #1", 2: "a b c", 3: "chair 1 #3", 4: "id 4", 5: "Tür"}


def test_the_header_names_the_mattes() -> None:
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
