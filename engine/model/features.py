"""Starting features of the initial anchors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def seeded_features(
    rgb: NDArray[np.uint8],
    class_id: NDArray[np.integer],
    instance_id: NDArray[np.integer],
    *,
    features: int,
    seed: int,
) -> NDArray[np.float32]:
    """Features that already tell anchors apart by colour and consistent label, float32 [M, ``features``].

    Scaffold-GS and the paper start from zero, which costs thousands of steps until equal anchors have drifted apart; a
    lift on a CPU has hundreds. Three entries hold ``rgb`` uint8 [M, 3] brought to [-1, 1]; the others hold random +-1
    codes of the class (half of them) and of the instance, no two alike; unknown labels (0) leave zeros.
    """
    seeded = np.zeros((len(rgb), features), np.float32)
    seeded[:, :3] = rgb.astype(np.float32) / 127.5 - 1.0
    half = 3 + (features - 3) // 2
    for labels, columns, purpose in ((class_id, slice(3, half), 11), (instance_id, slice(half, features), 12)):
        width = columns.stop - columns.start
        seeded[:, columns] = _codes(int(labels.max(initial=0)), width, np.random.default_rng([seed, purpose]))[labels]
    return seeded


def _codes(labels: int, width: int, random: np.random.Generator) -> NDArray[np.float32]:
    """Zeros for label 0 and a code of +-1 for each of 1..``labels``, float32 [``labels`` + 1, ``width``].

    As long as there are codes enough, no two labels share one: nothing else would tell two equal chairs apart.
    """
    sides = np.array([-1.0, 1.0], np.float32)
    codes = random.choice(sides, (labels + 1, width))
    codes[0] = 0.0
    taken: set[bytes] = set()
    for row in codes[1:]:
        while row.tobytes() in taken and len(taken) < 2**width:
            row[:] = random.choice(sides, width)
        taken.add(row.tobytes())
    return codes
