"""Has the kernels of the backward pass compiled, or loaded; ``python -m`` this module does so in a process of its own.

It does without torch, which takes seconds to import.
"""

from __future__ import annotations

import numpy as np

from ..machine.blackboard import new_board
from ..machine.undisturbed import undisturbed
from .chain_to_scene import CHAIN_BLOCK
from .kernels import Kernels, choose_kernels
from .projection import CAMERA
from .records import GRADIENT_WIDTH, MEMBERS, RECORD, TILE


def compile_backward(kernels: Kernels) -> None:
    """Call every kernel of the backward pass, with the types of arrays that ``backward_pass`` gives it: one pixel, one
    channel, and one Gaussian that no tile draws."""
    board = new_board()
    floats = {size: np.zeros(size, np.float32) for size in (1, 2, 3, 4, TILE, GRADIENT_WIDTH)}
    places, nobody, untouched = np.zeros(2, np.int64), np.zeros(0, np.int32), np.zeros(0, np.uint8)
    rest, nothing_blended = np.ones(1, np.float32), np.full(1, -1.0, np.float32)
    slot_gradients, slot_labels = floats[GRADIENT_WIDTH], floats[TILE]
    scratch = (
        np.zeros((1, kernels.unblend_scratch(1)), np.float32),
        np.zeros((1, MEMBERS), np.int32),
        np.zeros((1, TILE + 1), np.int64),
    )
    one_of = {columns: np.zeros((1, columns), np.float32) for columns in (2, 3, 4, RECORD)}
    unblending = (
        np.zeros(1, np.int64),
        places,
        nobody,
        nobody,
        one_of[RECORD].reshape(-1),
        rest,
        nothing_blended,
        floats[3],
        floats[1],
        1,
        floats[1],
        floats[1],
        1,
        1,
        untouched,
        slot_gradients,
        slot_labels,
        *scratch,
    )
    kernels.unblend(board, 1, unblending)
    scene = (one_of[3], one_of[3], one_of[4])
    gradients = (one_of[3], one_of[3], one_of[4], floats[1], one_of[3], one_of[2])
    room = np.zeros((1, TILE)), np.zeros((1, CHAIN_BLOCK))
    labels = slot_labels, 1, floats[1]
    geometry = slot_gradients, one_of[RECORD], *scene, np.ones(CAMERA), *room, *gradients
    kernels.gather(board, 1, (np.zeros(1, np.int64), places, untouched, labels, geometry))


if __name__ == "__main__":
    undisturbed(compile_backward, choose_kernels())
