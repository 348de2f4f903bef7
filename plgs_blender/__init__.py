"""From a lift's result to Blender's data-blocks, and back to pictures.

Functions here work the same from a script, a test, or an operator: they take a folder and a scene and never
look at selections, modes or windows. Start with `lift_scene.place_lift` and `lift_scene.save_lift`.
"""
