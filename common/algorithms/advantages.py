"""Generalised advantage estimation (thesis eq. 3.16 and 3.17), without torch."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Float64Array = npt.NDArray[np.float64]


def advantages(
    reward: Float64Array,
    value: Float64Array,
    next_value: Float64Array,
    terminated: Float64Array,
    goes_on: npt.NDArray[np.bool_],
    *,
    discount: float,
    gae_lambda: float,
) -> Float64Array:
    """Return the advantage estimates H (N,) of transitions in the order in which they happened.

    Only ``terminated`` cuts the bootstrap. Where the transition after one is not its successor (a time limit, a gap,
    the end of the rollout), the value of the next observation stands for all that would have come.

    Args:
        reward: (N,) r.
        value: (N,) v(o).
        next_value: (N,) v(o').
        terminated: (N,) 1 where o' reached the goal, else 0.
        goes_on: (N,) True where the next transition begins with this one's o'.
        discount: gamma.
        gae_lambda: lambda.
    """
    error = reward + discount * (1.0 - terminated) * next_value - value
    carried = (discount * gae_lambda * (goes_on & (terminated == 0.0))).tolist()
    estimates, later = error.tolist(), 0.0
    for t in reversed(range(len(estimates))):
        later = estimates[t] = estimates[t] + carried[t] * later
    return np.array(estimates, np.float64)
