"""The pictures of docs/passes.md and README's strip, from a finished lift of the sample:

    python -m docs.make_pictures camera LIFT          writes LIFT/shot.blend, with a moving camera "dolly" to bake
    python -m docs.make_pictures PICTURE... LIFT      strip, mask, layers, shot, matte, group, meshes, catcher; or all
    python -m docs.make_pictures.room LIFT.blend OUT.png    a picture of a lift's .blend

The project's own commands made everything that they show; docs/passes.md names them. These programs light, cut and
label it. They need no window and no GPU, and only read the lift.
"""

from run_plgs import load_package

load_package()  # as plgs, which the modules import
