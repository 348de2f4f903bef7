"""A scene's frames as files that any program can open: undistorted pictures, depth and masks in colours, a cloud."""

from __future__ import annotations

from .making import make_frames
