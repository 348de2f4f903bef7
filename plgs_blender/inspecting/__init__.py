"""Inspecting a lift that is in a scene: its lists, what is selected, what is shown, and which masks made it.

`lists` holds the data that a lift's collection carries (`collection.plgs`) and fills it. The other modules act on it
and on the lift's objects. They find everything by custom properties, so they work after undo, after loading, and
whatever the user renamed.
"""
