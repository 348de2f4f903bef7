"""Other systems, to compare PLGS with."""
