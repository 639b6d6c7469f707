"""Case: what distinguishes one trajectory of a sweep from another."""

from dataclasses import KW_ONLY
from typing import Any, final

import equinox as eqx


@final
class Case(eqx.Module):
    """Start, params and inputs of one trajectory of a sweep, or of many.

    Each argument is that of `jl.simulate`, with the same units. One of v0 and u0 is given.

    Of many trajectories arrays have a leading axis of length n in front: q0 of n_coordinates
    numbers is (n, n_coordinates), a number in params (n,). Shared by all are Python's numbers,
    arrays without axes, starts without the leading axis, and what
    `np.broadcast_to(x, (n, *x.shape))` has repeated, which takes no memory. Inputs of many are
    made by `jax.vmap`, such as `jax.vmap(jl.LinearInterpolation)(ts, values)`.

    Attributes:
        q0: coordinates at ts[0], an array or a dict by name; m or rad.
        v0: velocities there, in the same form; m/s or rad/s.
        params: of the Lagrangian and the forces.
        u0: quasi-velocities there; m/s or rad/s.
        x0: states beside (q, v) there.
        inputs: dict by name.
        ts: (s,) times in s; None for those of the sweep. Their number must be that of the sweep.
    """

    q0: Any
    v0: Any = None
    params: Any = None
    _: KW_ONLY
    u0: Any = None
    x0: Any = None
    inputs: Any = None
    ts: Any = None
