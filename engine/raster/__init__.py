"""Gaussians to pixels and back: one functional interface, several back ends.

``rasterize`` draws anisotropic 3D Gaussians into a pinhole camera and is differentiable in everything that
describes the Gaussians. Back ends: ``numba`` (CPU, the default), ``gsplat`` (CUDA, if installed).
"""

from __future__ import annotations

from .interface import rasterize
from .rendering import Rendering
