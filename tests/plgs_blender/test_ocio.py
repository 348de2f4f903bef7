"""A studio's OCIO configuration need not have Blender's view transforms."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

CONFIGURATION = """ocio_profile_version: 2
roles: {{default: raw, scene_linear: lin, data: raw, color_picking: disp}}
displays:
  Monitor:
{views}
colorspaces:
  - !<ColorSpace> {{name: raw, isdata: true}}
  - !<ColorSpace> {{name: lin, isdata: false}}
  - !<ColorSpace>
    name: disp
    isdata: false
    from_scene_reference: !<ExponentTransform> {{value: [2.2, 2.2, 2.2, 1], direction: inverse}}
"""
START = """
import tests.conftest
from plgs.plgs_blender.passes import _new_scene
from plgs.plgs_blender.viewport import start_file
print("chosen:", start_file().view_settings.view_transform, _new_scene("x").view_settings.view_transform, sep="|")
"""


@pytest.mark.parametrize(
    ("views", "chosen"),
    [(None, "Standard"), (["ACES 1.0 - SDR Video", "Un-tone-mapped", "Raw"], "Un-tone-mapped"), (["Plain"], "Plain")],
    ids=["Blender's own", "like ACES", "minimal"],
)
def test_a_file_is_made_with_any_configuration(
    views: list[str] | None, chosen: str, tmp_path: Path, root: Path
) -> None:
    environment = {name: value for name, value in os.environ.items() if name != "OCIO"} | {"PYTHONPATH": str(root)}
    if views is not None:
        lines = "\n".join(f'    - !<View> {{name: "{view}", colorspace: disp}}' for view in views)
        (tmp_path / "config.ocio").write_text(CONFIGURATION.format(views=lines))
        environment["OCIO"] = str(tmp_path / "config.ocio")
    done = subprocess.run(
        [sys.executable, "-c", START], cwd=root, env=environment, capture_output=True, text=True, timeout=300
    )
    assert f"chosen:|{chosen}|{chosen}" in done.stdout, done.stdout + done.stderr
