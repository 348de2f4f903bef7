"""Run by test_labelling_programs.py: what Datumaro, whose reader CVAT imports with, and labelCloud make of an export.

Their own readers run. What those import and do not need, windows and other formats, is not installed.
"""

from __future__ import annotations

import importlib.util
import json
import sys
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from unittest.mock import MagicMock

ABSENT = {
    "OpenGL", "PyQt5", "cachetools", "defusedxml", "imagesize", "json_stream", "lxml", "orjson", "pandas",
    "pkg_resources", "pyarrow", "ruamel", "shapely",
}  # fmt: skip


class Absent(MetaPathFinder, Loader):
    """An empty module for each of these packages."""

    def find_spec(self, name: str, *_: object) -> ModuleSpec | None:
        return ModuleSpec(name, self, is_package=True) if name.partition(".")[0] in ABSENT else None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        module = MagicMock(name=spec.name)
        module.__path__, module.__spec__ = [], spec
        if spec.name == "orjson":
            module.loads, module.JSONDecodeError = json.loads, json.JSONDecodeError
        if spec.name == "pkg_resources":
            module.resource_filename = resource_filename
        return module

    def exec_module(self, module: ModuleType) -> None:
        pass


def resource_filename(package: str, name: str) -> str:
    spec = importlib.util.find_spec(package)
    assert spec is not None and spec.submodule_search_locations is not None
    return str(Path(next(iter(spec.submodule_search_locations)), name))


def main(packages: str, export: Path) -> None:
    sys.path.append(packages)
    sys.meta_path.insert(0, Absent())
    from datumaro.plugins.data_formats.sly_pointcloud.base import SuperviselyPointCloudBase
    from labelCloud.io.labels.centroid import CentroidFormat

    found = SuperviselyPointCloudBase(str(export / "cvat/meta.json"))
    (item,), (labels,) = found, found.categories().values()
    cuboids = [
        {"class": labels[one.label].name, "name": one.attributes["instance"], "id": one.attributes["track_id"],
         "centre": one.position, "rotation": one.rotation, "size": one.scale}
        for one in item.annotations
    ]  # fmt: skip
    boxes = CentroidFormat(export / "labelcloud/labels", 9, relative_rotation=False).import_labels(Path("points.ply"))
    shown = [
        {"class": one.get_classname(), "centre": one.get_center(), "size": one.get_dimensions(),
         "rotation": one.get_rotations(), "corners": [list(corner) for corner in one.get_vertices().tolist()]}
        for one in boxes
    ]  # fmt: skip
    print("FOUND" + json.dumps({"points": item.media.path, "cuboids": cuboids, "boxes": shown}))


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
