"""What is wrong with a scene? Depth is projected into other views; edges, normals, pictures and labels are compared."""

from __future__ import annotations

from .findings import Diagnosis, Finding, write_findings
from .mend import write_mended
from .run import diagnose, diagnose_quickly

__all__ = ["Diagnosis", "Finding", "diagnose", "diagnose_quickly", "write_findings", "write_mended"]
