"""PLGS itself: panoptic lifting with structured 3D Gaussians. Never imports bpy."""

from __future__ import annotations

__version__ = "0.1.0"
