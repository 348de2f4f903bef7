"""The objects' oriented boxes, as JSON and as a table."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from typing import Any

from ..gates import table_cell
from ..job import write_atomically
from .source import FinishedLift

FIELDS = ("id", "name", "class_id", "class_name", "centre", "size", "yaw", "rotation", "score", "points", "views")
"""Fields of an `Instance` that are exported: metres in the world, z up; ``yaw`` in radians about +z, ``rotation`` the
same, wxyz."""
_AXES = {"centre": "xyz", "size": "xyz", "rotation": "wxyz"}


def export_boxes(lift: FinishedLift, output: Path) -> None:
    """boxes.json and boxes.csv (one column per number, such as size_x). Raises OSError."""
    boxes: list[dict[str, Any]] = [{field: getattr(one, field) for field in FIELDS} for one in lift.listed]
    content = {"up": "z", "unit": "m", "boxes": boxes}
    write_atomically(output / "boxes.json", json.dumps(content, indent=1, ensure_ascii=False) + "\n")
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow([f"{field}_{axis}" if axis else field for field in FIELDS for axis in _AXES.get(field, ("",))])
    writer.writerows(
        [number for field in FIELDS for number in (box[field] if field in _AXES else [table_cell(box[field])])]
        for box in boxes
    )
    write_atomically(output / "boxes.csv", table.getvalue())
