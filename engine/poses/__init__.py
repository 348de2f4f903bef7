"""Poses of photos and films, by COLMAP's mapping (the package pycolmap)."""

from __future__ import annotations

from .making import Made, make_poses

__all__ = ["Made", "make_poses"]
