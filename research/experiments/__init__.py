"""Lifts scenes in many ways, one after the other, and writes tables of how good the results are."""
