"""Gaussians to pixels and back: one functional interface, several back ends.

``rasterize`` draws anisotropic 3D Gaussians into a pinhole camera and is differentiable in everything that
describes the Gaussians. Back ends: ``numba`` (CPU, the default), ``gsplat`` (CUDA, if installed),
``reference`` (dense float64 torch, the oracle of the tests).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .interface import rasterize
    from .rendering import Rendering

__all__ = ["Rendering", "rasterize"]


def __getattr__(name: str) -> Any:
    """Import torch only when it is needed."""
    if name == "rasterize":
        from .interface import rasterize

        return rasterize
    if name == "Rendering":
        from .rendering import Rendering

        return Rendering
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
