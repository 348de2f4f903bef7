"""Clusters of points by their density: HDBSCAN (Campello et al. 2013) in which one neighbour makes a point dense, so
that its hierarchy is single linkage."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.hierarchy import linkage

LEAST_DISTANCE = 1e-9
NOISE = -1


def density_clusters(points: NDArray[np.floating], least: int) -> NDArray[np.int64]:
    """The cluster of each of ``points`` [N, D], int64 [N], from 0, or ``NOISE``; each has at least ``least`` points.

    Those branches of the hierarchy are clusters that last longest, point by point, among the ones they lie in and the
    ones within them ("excess of mass"); all points may be one cluster. Takes memory for N^2 / 2 distances.
    """
    label = np.full(len(points), NOISE, np.int64)
    if len(points) < max(least, 2):
        return label
    tree = linkage(np.asarray(points, np.float64), "single")
    branches = _Branches(tree, max(least, 2))
    for number, node in enumerate(sorted(branches.lasting(), key=lambda node: branches.leaves(node)[0])):
        label[branches.leaves(node)] = number
    return label


class _Branches:
    """The hierarchy from the top: a branch begins where both sides of a split have ``least`` points, and lasts while it
    loses fewer. ``tree`` [N - 1, 4] as scipy's ``linkage`` returns it."""

    def __init__(self, tree: NDArray[np.float64], least: int) -> None:
        self.tree, self.least = tree, least
        self.points = len(tree) + 1
        root = 2 * len(tree)
        self.node, self.born, self.mass = [root], [0.0], [0.0]
        self.children: list[list[int]] = [[]]
        stack = [(root, 0)]
        while stack:
            stack.extend(self._split(*stack.pop()))

    def _split(self, node: int, branch: int) -> list[tuple[int, int]]:
        """What is left below a node, and the branch that it belongs to."""
        left, right, distance, size = self.tree[node - self.points]
        density = 1.0 / max(distance, LEAST_DISTANCE)
        large = [side for side in (int(left), int(right)) if self._size(side) >= self.least]
        lost = int(size) - (self._size(large[0]) if len(large) == 1 else 0)
        self.mass[branch] += (density - self.born[branch]) * lost
        if len(large) < 2:
            return [(side, branch) for side in large]
        return [(side, self._begin(side, branch, density)) for side in large]

    def _begin(self, node: int, parent: int, density: float) -> int:
        self.node.append(node)
        self.born.append(density)
        self.mass.append(0.0)
        self.children.append([])
        self.children[parent].append(len(self.node) - 1)
        return len(self.node) - 1

    def _size(self, node: int) -> int:
        return 1 if node < self.points else int(self.tree[node - self.points, 3])

    def lasting(self) -> list[int]:
        """The nodes of the branches that are clusters."""
        best, is_best = [0.0] * len(self.node), [False] * len(self.node)
        for branch in reversed(range(len(self.node))):  # the branches within it come after it
            within = sum(best[child] for child in self.children[branch])
            is_best[branch] = self.mass[branch] >= within
            best[branch] = max(self.mass[branch], within)
        found, stack = [], [0]
        while stack:
            branch = stack.pop()
            if is_best[branch]:
                found.append(self.node[branch])
            else:
                stack.extend(self.children[branch])
        return found

    def leaves(self, node: int) -> list[int]:
        """The points below a node, ascending."""
        found, stack = [], [node]
        while stack:
            node = stack.pop()
            if node < self.points:
                found.append(node)
            else:
                stack.extend(self.tree[node - self.points, :2].astype(int).tolist())
        return sorted(found)
