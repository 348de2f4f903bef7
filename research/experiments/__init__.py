"""Lift scenes in many ways, one after the other, and write tables of how good the results are."""
