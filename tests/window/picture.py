"""A picture of Blender's window with a lift in it, for docs/passes.md; `make test-window` makes the tree and the zip:

    PLGS_WINDOW_TREE=build/blender-trixie .venv/bin/python tests/window/picture.py lifts/demo OUT.png

The lift and its scene lie within this folder: the tree sees nothing else.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from pathlib import Path

import cv2
from blender import Window
from tree import ROOT, Tree, paths_of_this_python

INSTANCE = 6
"""The sample's sofa: chosen in the list, its points stand out."""
# A room shows its best from its overview camera; classes tell points apart where photos are dim.
SHOW = f"""
area = max((each for each in bpy.context.window_manager.windows[0].screen.areas if each.type == 'VIEW_3D'),
           key=lambda each: each.width * each.height)
area.spaces.active.region_3d.view_perspective = 'CAMERA'
region = next(each for each in area.regions if each.type == 'WINDOW')
with bpy.context.temp_override(window=bpy.context.window_manager.windows[0], area=area, region=region):
    bpy.ops.plgs.show_colours()
    bpy.ops.plgs.select_instance(instance={INSTANCE})
"""


class QuietWindow(Window):
    """One that lifts nothing, so that no kernels have to be compiled meanwhile."""

    def _compile_kernels(self) -> None:
        self._warm_up = None


def take(lift: Path, out: Path) -> None:
    """Open the lift in a new file, look at it through its overview camera, and keep the screen."""
    (package,) = (ROOT / "build").glob("plgs-*.zip")
    folder = Path(tempfile.mkdtemp(prefix="picture-", dir=ROOT / "build"))
    tree = Tree((ROOT / os.environ["PLGS_WINDOW_TREE"]).resolve(), [ROOT, *paths_of_this_python()])
    try:
        window = QuietWindow(tree, folder, package)
        try:
            window.new_file()
            window.run(f"bpy.ops.plgs.place_lift(lift_folder={str(lift.resolve())!r})", timeout=300)
            window.run(SHOW, timeout=300)
            window.open_sidebar()
            window.settle(timeout=300)
            cv2.imwrite(str(out), window.picture()[:, :, ::-1])
        finally:
            window.close()
    finally:
        tree.close()
    shutil.rmtree(folder)


if __name__ == "__main__":
    take(Path(sys.argv[1]), Path(sys.argv[2]))
