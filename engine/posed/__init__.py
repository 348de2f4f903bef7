"""Where were the pictures taken? Cameras, classes, posed frames and plain folders; only numpy, for Blender's sake."""

from __future__ import annotations

from .classes import VOID, Category, ClassTable, distinct_colour
from .frames import Camera, PosedFrame, PosedScene, Size, SparsePoints, size_within
