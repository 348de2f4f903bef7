"""Find what is wrong with a scene: project depth into other views, and compare edges, normals, pictures, labels."""

from __future__ import annotations

from .findings import Diagnosis, Finding, write_findings
from .mend import write_mended
from .run import diagnose, diagnose_quickly

__all__ = ["Diagnosis", "Finding", "diagnose", "diagnose_quickly", "write_findings", "write_mended"]
