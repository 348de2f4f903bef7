"""Inspect a lift in a scene: its lists, the selection, what is shown, and which masks made it.

`lists` fills the data of a lift's collection (`collection.plgs`); the other modules act on it and on the lift's
objects. They find everything by custom properties, so that undo, loading and renaming do no harm."""
