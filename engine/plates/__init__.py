"""Clean plates: objects are taken out of a finished lift, and the room behind them is drawn instead.

What other photos saw behind an object is taken from their pixels. What no photo saw is guessed from the planes that the
object stands on or hangs at. The result is a `Fill` of new Gaussians, so every view and every export shows one room.
`removal` is the way from end to end: `views` (the photos), `leaving` (what goes), `planes` (what stands behind),
`texture` (a plane as the photos show it), `completion` (what they do not show), `fill` (new Gaussians).
"""

from __future__ import annotations

from .removal import remove, without
