"""One reader a format of masks. ``find_mask_format`` tells which one reads a folder or file."""

from __future__ import annotations

from .recognising import MASK_FORMATS, MaskFormat, find_mask_format
from .source import FoundMask, FoundSegment, MaskSource

__all__ = ["MASK_FORMATS", "FoundMask", "FoundSegment", "MaskFormat", "MaskSource", "find_mask_format"]
