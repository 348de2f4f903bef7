"""The objects' oriented boxes, as JSON and as a table."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..job import write_atomically

FIELDS = ("id", "name", "class_id", "class_name", "centre", "size", "yaw", "rotation", "score", "points", "views")
"""Of a record of instances.json: metres in the world, z up; ``yaw`` radians about +z, ``rotation`` the same, wxyz."""
_AXES = {"centre": "xyz", "size": "xyz", "rotation": "wxyz"}


def write_boxes(output: Path, records: Sequence[Mapping[str, Any]]) -> None:
    """boxes.json and boxes.csv (a column a number, such as size_x). Raises OSError."""
    boxes = [{field: record[field] for field in FIELDS} for record in records]
    content = {"up": "z", "unit": "m", "boxes": boxes}
    write_atomically(output / "boxes.json", json.dumps(content, indent=1, ensure_ascii=False) + "\n")
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow([column for field in FIELDS for column in _columns(field)])
    writer.writerows([number for field in FIELDS for number in _numbers(box[field])] for box in boxes)
    write_atomically(output / "boxes.csv", table.getvalue())


def _columns(field: str) -> list[str]:
    return [f"{field}_{axis}" for axis in _AXES[field]] if field in _AXES else [field]


def _numbers(value: Any) -> list[Any]:
    return list(value) if isinstance(value, list | tuple) else [value]
