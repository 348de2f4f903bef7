"""The error of rendered depth."""

from __future__ import annotations

import numpy as np
import pytest

from engine.metrics.images import DepthErrors


def _plane(metres: float) -> np.ndarray:
    return np.full((4, 5), metres, np.float32)


def test_median_and_share_over_all_pixels_of_all_views() -> None:
    errors, random = DepthErrors(), np.random.default_rng(0)
    every = []
    for _ in range(3):
        measured = random.uniform(0.5, 6.0, (40, 50)).astype(np.float32)
        rendered = measured + random.normal(0.0, 0.06, measured.shape).astype(np.float32)
        errors.add(rendered, np.ones_like(measured), measured)
        every.append(np.abs(rendered.astype(np.float64) - measured))
    assert errors.median == pytest.approx(np.median(every), abs=1e-4)
    assert errors.close_share == pytest.approx(np.mean(np.array(every) <= 0.05))


def test_pixels_without_depth_and_holes_do_not_count() -> None:
    errors = DepthErrors()
    measured, alpha = _plane(2.0), _plane(1.0)
    measured[0], alpha[1] = 0.0, 0.4
    rendered = _plane(9.0)
    rendered[2:] = 2.02
    errors.add(rendered, alpha, measured)
    assert errors.median == pytest.approx(0.02, abs=1e-4) and errors.close_share == 1.0


def test_nothing_to_count() -> None:
    errors = DepthErrors()
    errors.add(_plane(1.0), _plane(1.0), _plane(0.0))
    assert errors.median is None and errors.close_share is None


def test_errors_beyond_all_bins_are_still_errors() -> None:
    errors = DepthErrors()
    errors.add(_plane(60.0), _plane(1.0), _plane(2.0))
    assert errors.median is not None and errors.median > 9.9 and errors.close_share == 0.0


def test_a_view_of_another_size_is_refused() -> None:
    with pytest.raises(ValueError, match="differ"):
        DepthErrors().add(_plane(1.0), _plane(1.0)[1:], _plane(1.0))
