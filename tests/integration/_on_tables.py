"""A mass under a force given by a table."""

import jaxlag as jl


def _kinetic(t, q, v, params):
    return 0.5 * v[0] ** 2 + 0.5 * params["k"] * q[0] ** 2


mass = jl.System(
    _kinetic,
    ("x",),
    forces=(jl.GeneralizedForce(lambda t, q, v, params, inputs: inputs["u"][None], "push"),),
)
"""x'' = k x + u(t)."""
FREE = {"k": 0.0}


def moved(table, ts, start=(0.1, 0.2), params=FREE, **options):
    return jl.simulate(
        mass, [start[0]], [start[1]], ts, params, inputs={"u": table}, throw=False, **options
    )
