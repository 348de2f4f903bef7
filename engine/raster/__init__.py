"""Rasterises Gaussians to pixels and takes gradients back: one functional interface, several back ends.

``rasterize`` draws anisotropic 3D Gaussians as seen by a pinhole camera, and is differentiable in everything that
describes the Gaussians. Back ends: ``numba`` (CPU, the default), ``gsplat`` (CUDA, if installed)."""

from __future__ import annotations

from .interface import rasterize
from .rendering import Rendering
