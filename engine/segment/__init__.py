"""Masks by transformers' Mask2Former, for scenes that have none."""

from __future__ import annotations

from .making import Job, Segmenter, begin_job, make_masks
from .network import Mask2Former, load_model

__all__ = ["Job", "Mask2Former", "Segmenter", "begin_job", "load_model", "make_masks"]
