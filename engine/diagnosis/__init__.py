"""Finds what is wrong with a scene: projects depth into other views, compares edges, normals, pictures, labels."""

from __future__ import annotations

from .findings import Diagnosis, Finding, write_findings
from .mend import write_mended
from .run import diagnose, diagnose_quickly

__all__ = ["Diagnosis", "Finding", "diagnose", "diagnose_quickly", "write_findings", "write_mended"]
