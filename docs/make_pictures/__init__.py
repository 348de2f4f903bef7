"""The pictures of docs/passes.md, of a finished lift of the sample:

    python -m docs.make_pictures camera LIFT          writes LIFT/shot.blend, with a moving camera "dolly" to bake
    python -m docs.make_pictures PICTURE... LIFT      mask, layers, shot, matte, group, meshes, catcher; or all

All that is seen was made by the project's own commands, which that page tells; here it is lit, cut and labelled. Needs
no window and no GPU. The lift is only read.
"""

from run_plgs import load_package

load_package()  # as plgs, which the modules import
