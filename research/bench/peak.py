"""How fast this machine multiplies and adds, which the bench prints beside its figures."""

from __future__ import annotations

import time

import numpy as np

from engine.machine.compiled import Array, compiled
from engine.machine.vectors import WIDTH, broadcast, fma, load, store

F = np.float32
CHAINS = 12
"""Independent multiply-adds in flight: enough for the latency, few enough for sixteen registers... of sixteen
floats."""


@compiled
def multiply_add(rounds: int, values: Array) -> None:
    """12 x 16 multiply-adds a round, all in registers."""
    a = b = c = d = e = f = g = h = i = j = k = m = load(values, 0)
    scale, shift = broadcast(F(0.999)), broadcast(F(0.001))
    for _ in range(rounds):
        a, b, c, d = fma(a, scale, shift), fma(b, scale, shift), fma(c, scale, shift), fma(d, scale, shift)
        e, f, g, h = fma(e, scale, shift), fma(f, scale, shift), fma(g, scale, shift), fma(h, scale, shift)
        i, j, k, m = fma(i, scale, shift), fma(j, scale, shift), fma(k, scale, shift), fma(m, scale, shift)
    store(values, 0, a + b + c + d + e + f + g + h + i + j + k + m)


def fma_peak(seconds: float = 0.2) -> float:
    """GFLOP/s of one thread, the best of runs within ``seconds`` of processor time."""
    values = np.arange(WIDTH, dtype=np.float32)
    multiply_add(1000, values)
    rounds, best = 200_000, 0.0
    until = time.process_time() + seconds
    while time.process_time() < until:
        start = time.perf_counter()
        multiply_add(rounds, values)
        best = max(best, rounds * CHAINS * WIDTH * 2 / (time.perf_counter() - start) / 1e9)
    return best
