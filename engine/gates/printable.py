"""Texts of other people's files on their way to a terminal."""

from __future__ import annotations


def printable(text: object) -> str:
    """The text without what a terminal takes for a command, or cannot show: each such character becomes "?".

    Line breaks and tabs stay. Colours, cursor movements and half surrogate pairs (of paths that are no UTF-8) go.
    """
    return "".join(each if each.isprintable() or each in "\n\t" else "?" for each in str(text))
