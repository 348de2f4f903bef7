"""Clean plates: take objects out of a finished lift, and draw the room behind them instead.

What other photos saw behind an object is taken from their pixels. What no photo saw is guessed from the planes that the
object stands on or hangs at. The result is a `Fill` of new Gaussians, so every view and every export shows the same
room. `removal` does it from end to end, with `views` (the photos), `leaving` (what is removed), `planes` (what stands
behind), `texture` (a plane as the photos show it), `completion` (what they do not show), `fill` (new Gaussians), and
`remains` (what is left to do)."""

from __future__ import annotations

from .removal import make_fills, remove, without
