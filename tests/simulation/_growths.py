"""Transition matrices of a growth, and states of a motion."""

import numpy as np

TIGHT = {"rtol": 1e-12, "atol": 1e-12}


def product(growth):
    """Phi from the first save time to the last."""
    return np.linalg.multi_dot(list(np.asarray(growth.transition)[::-1]))


def states(motion):
    return np.concatenate([motion.q, motion.v], -1)
