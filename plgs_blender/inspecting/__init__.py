"""Inspecting a lift in a scene: its lists, the selection, what is shown, and which masks made it.

`lists` defines and fills the data of a lift's collection (`collection.plgs`). The other modules act on it and on the
lift's objects. They find everything by custom properties, so they work after undo, after loading, and whatever the user
renamed.
"""
