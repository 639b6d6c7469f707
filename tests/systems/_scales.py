"""Sizes of sums; rounding is relative to these."""

import numpy as np


def scale_of_T(system, params, t, q, v):
    moments = np.diagonal(system.mass_matrix(q, v, params, t=t))
    return 0.5 * np.sum(np.sqrt(moments) * np.abs(v)) ** 2
