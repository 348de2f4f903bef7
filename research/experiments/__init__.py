"""Lifts scenes in many ways, one after the other, and writes tables of what they are worth."""
