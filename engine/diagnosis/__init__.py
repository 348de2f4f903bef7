"""What is wrong with a scene? Measured: depth reprojected into other views, edges, normals, pictures, labels."""

from __future__ import annotations

from .finding import Diagnosis, Finding
from .mend import write_mended
from .run import diagnose
from .written import write_findings

__all__ = ["Diagnosis", "Finding", "diagnose", "write_findings", "write_mended"]
