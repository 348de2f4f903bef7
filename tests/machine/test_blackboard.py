"""The board on which calls are written."""

from __future__ import annotations

from engine.machine.blackboard import ROWS, WORDS, new_board


def test_a_board_has_whole_cache_lines() -> None:
    board = new_board()
    assert board.shape == (ROWS, WORDS) and board.ctypes.data % 64 == 0 and not board.any()
