"""Scenes too large for one machine: they are cut into blocks, lifted separately, and joined into one result."""
