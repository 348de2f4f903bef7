"""How often pixels are right, by their confidence."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from research import reliability as r


def test_the_expected_error_is_the_gap_between_the_curve_and_the_diagonal() -> None:
    probability, right = np.array([0.95] * 4 + [0.55] * 4), np.array([1, 1, 1, 0, 1, 1, 0, 0])
    curve = r.reliability(probability, right)
    assert np.allclose(curve[:, [5, 9]].T, [[4, 0.55, 0.5], [4, 0.95, 0.75]]) and curve.sum() == 8 + 1.5 + 1.25
    assert r.error(curve) == pytest.approx((0.2 + 0.05) / 2)
    assert r.error(r.reliability(probability[:0], right[:0])) == 0


def test_the_table_and_the_diagram(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pixels = np.array([[1.0] * 4, [0.75] * 4, [1, 1, 1, 0]], np.float32)
    monkeypatch.setattr(r, "pixels_of", lambda lift: pixels)
    pytest.importorskip("matplotlib")
    lines = list(r.reliability_table([tmp_path / "a", tmp_path / "b"], tmp_path / "curve.png"))
    assert lines[2:] == [f"| {name} | 75.0 % | 0.250 | 0.000 |" for name in ("a", "b", "all together")]
    assert (tmp_path / "curve.png").stat().st_size > 1000
