"""Soft coverage as ranks, hashes against published values, names that Blender can take."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from engine.passes import cryptomatte
from engine.passes.baked_view import ShownInstances, bake_view
from engine.passes.cryptomatte import RANKS, SMALLEST, rank_coverage
from engine.passes.layers import STEPS
from engine.posed.names import murmur3
from tests.passes.agreement import coverage_of
from tests.passes.views import CHAIR, CLASSES, EDGE, LEFT, NAMES, NOTHING, RIGHT, WALL, made_rendering

LAYERS = ("CryptoInstance", "CryptoClass")
STEP = 0.5 / STEPS
"""The largest change by rounding."""


@pytest.mark.parametrize(
    ("text", "seed", "expected"),
    [("", 0, 0), ("", 1, 0x514E28B7), ("test", 0, 0xBA6BD213), ("Hello, world!", 0, 0xC0363E43)],
)
def test_cryptomatte_names_are_hashed_with_murmur3(text: str, seed: int, expected: int) -> None:
    assert murmur3(text.encode(), seed) == expected


def mattes(instance_classes: dict[int, int] | None = None) -> dict[str, np.ndarray]:
    """Every rank channel of the hand-made rendering."""
    rendering = made_rendering()
    view = bake_view([rendering], rendering.camera, CLASSES, ShownInstances(NAMES, instance_classes))
    found: dict[str, np.ndarray] = {}
    for matte in view.mattes:
        found |= cryptomatte.channels(matte.layer.name, matte.ranks)
    return found


def test_instance_mattes_cover_no_more_than_thing_classes() -> None:
    found = mattes()
    chair_1, chair_2 = (coverage_of(found, "CryptoInstance", name) for name in ("chair 1", "chair 2"))
    assert chair_1[LEFT] == pytest.approx(1.0, abs=STEP)
    assert chair_1[EDGE] == pytest.approx(0.6, abs=STEP)
    assert chair_2[EDGE] == pytest.approx(0.0, abs=1e-6)
    assert chair_2[RIGHT] == pytest.approx(1.0, abs=STEP)
    assert not chair_2[0, 3:5].any()


def test_instance_mattes_hold_each_objects_own_coverage() -> None:
    found = mattes({3: CHAIR, 70001: WALL})
    assert coverage_of(found, "CryptoInstance", "chair 1")[EDGE] == pytest.approx(0.7, abs=STEP)
    assert not coverage_of(found, "CryptoInstance", "chair 2").any()  # what is stuff is not an object


def test_cryptomatte_ranks_list_the_largest_coverages() -> None:
    found = mattes()
    assert len(found) == 24
    assert found["CryptoClass00.r"][0, 2] == np.float32(cryptomatte.name_float("chair"))
    assert found["CryptoClass00.g"][0, 2] == pytest.approx(0.6, abs=STEP)
    assert found["CryptoClass00.b"][0, 2] == np.float32(cryptomatte.name_float("wall"))
    assert found["CryptoClass00.a"][0, 2] == pytest.approx(0.4, abs=STEP)
    assert not any(values[NOTHING].any() for values in found.values())


def test_cryptomatte_ranks_sum_to_the_coverage() -> None:
    found, rendering = mattes({3: CHAIR, 70001: CHAIR}), made_rendering()
    shares = {layer: sum(found[f"{layer}0{k}.{c}"] for k in range(3) for c in "ga") for layer in LAYERS}
    np.testing.assert_allclose(shares["CryptoClass"], rendering.alpha, atol=RANKS * STEP)
    np.testing.assert_allclose(shares["CryptoInstance"], rendering.instance_coverage.sum(axis=-1), atol=RANKS * STEP)
    for layer in LAYERS:
        falling = np.stack([found[f"{layer}0{k}.{c}"] for k in range(3) for c in "ga"])
        assert (np.diff(falling, axis=0) <= 0).all()  # the strongest first


def test_the_cryptomatte_manifest_lists_every_id_as_blender_reads_it() -> None:
    rendering = made_rendering()
    view = bake_view([rendering], rendering.camera, CLASSES, ShownInstances(NAMES, None))
    for matte in view.mattes:
        header = cryptomatte.header(matte.layer.name, matte.layer.names)
        (prefix,) = {key.rpartition("/")[0] for key in header}
        assert prefix == f"cryptomatte/{murmur3(matte.layer.name.encode()):08x}"[:19]
        assert header[f"{prefix}/hash"] == "MurmurHash3_32" and header[f"{prefix}/name"] == matte.layer.name
        assert header[f"{prefix}/conversion"] == "uint32_to_float32"
        bits = {int(value, 16) for value in json.loads(header[f"{prefix}/manifest"]).values()}
        planes = cryptomatte.channels(matte.layer.name, matte.ranks)
        ids = np.concatenate([planes[f"{matte.layer.name}0{k}.{c}"].ravel() for k in range(3) for c in "rb"])
        assert set(ids[ids != 0].view(np.uint32).tolist()) <= bits


@settings(deadline=None)
@given(st.text())
def test_cryptomatte_hashes_are_finite_normal_floats(name: str) -> None:
    if name.isprintable():
        assert np.isfinite(cryptomatte.name_float(name))
        assert abs(cryptomatte.name_float(name)) >= np.finfo(np.float32).tiny


def sorted_pairs(shares: np.ndarray, ids: np.ndarray, limit: float | None) -> list[tuple[float, float]]:
    """The pairs of one pixel, as the docstring of ``rank_coverage`` defines them."""
    counted = [(float(share), float(one)) for share, one in zip(shares, ids, strict=True) if share >= SMALLEST]
    ordered = sorted(counted, key=lambda pair: -pair[0])  # stable: ties to the earlier
    total = sum(share for share, _ in ordered)
    if limit is not None:
        total, left, filled = min(total, limit), limit, []
        for share, one in ordered:
            filled.append((min(share, left), one))
            left -= filled[-1][0]
        ordered = [pair for pair in filled if pair[0] >= SMALLEST]
    pairs = [(one, share / max(total, 1.0)) for share, one in ordered[:RANKS]]
    return pairs + [(0.0, 0.0)] * (RANKS - len(pairs))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000))
def test_cryptomatte_ranks_match_a_full_sort(seed: int) -> None:
    random = np.random.default_rng(seed)
    height, width, count = 3, 5, int(random.integers(1, 20))
    coverage = random.choice(np.array([0, 1e-3, 0.05, 0.1, 0.2, 0.6], np.float32), (height, width, count))
    columns = random.permutation(count)[: int(random.integers(0, count + 1))].tolist()
    ids = random.uniform(1, 2, len(columns)).astype(np.float32)
    alpha = random.choice(np.array([0, 1], np.float32), (height, width))
    limit = random.uniform(0, 1, (height, width)).astype(np.float32) if seed % 2 else None
    out = np.full((2 * RANKS, height, width), np.nan, np.float32)
    rank_coverage(coverage, columns, ids, alpha, limit=limit, out=out)
    for pixel in np.ndindex(height, width):
        expected = np.zeros((RANKS, 2))
        if alpha[pixel]:
            expected[:] = sorted_pairs(coverage[pixel][columns], ids, None if limit is None else float(limit[pixel]))
        np.testing.assert_allclose(out[(slice(None), *pixel)].reshape(RANKS, 2), expected, atol=RANKS / 2 / STEPS)
    below = np.full((2 * RANKS, height + 2, width), np.nan, np.float32)
    rank_coverage(coverage, columns, ids, alpha, limit=limit, out=below, first_row=2)
    assert (below[:, 2:] == out).all() and np.isnan(below[:, :2]).all()
    shares = out[1::2]
    assert (np.diff(shares, axis=0) <= 0).all() and shares.sum(axis=0).max() <= 1 + 1e-5


def test_cryptomattes_are_identical_for_any_number_of_threads() -> None:
    import torch

    random = np.random.default_rng(0)
    coverage = random.uniform(0, 0.2, (97, 101, 12)).astype(np.float32)
    alpha, threads, seen = np.ones((97, 101), np.float32), torch.get_num_threads(), []
    try:
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            out = np.empty((2 * RANKS, 97, 101), np.float32)
            rank_coverage(coverage, range(12), np.arange(1, 13, dtype=np.float32), alpha, limit=None, out=out)
            seen.append(out.tobytes())
    finally:
        torch.set_num_threads(threads)
    assert seen[0] == seen[1] == seen[2]
