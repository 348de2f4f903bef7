"""Cameras, classes, posed frames and plain folders. Uses only numpy, as Blender imports it."""

from __future__ import annotations

from .classes import VOID, Category, ClassTable, distinct_colour
from .frames import Camera, PosedFrame, PosedScene, Size, SparsePoints, size_within
