"""A system of two springs, and a check that `simulate` refuses arguments."""

import re

import pytest

import jaxlag as jl

PARAMS = {"m": 2.0, "k": 8.0}


def kinetic(t, q, v, params):
    return 0.5 * params["m"] * v @ v


def potential(t, q, params):
    return 0.5 * params["k"] * q @ q


SYSTEM = jl.System(coordinates=("x", "y"), kinetic=kinetic, potential=potential)
WHOLE = jl.System(SYSTEM.lagrangian, ("x", "y"))
Q0, V0, TS = [1.0, 2.0], [0.0, 1.0], [0.0, 1.0]


def run(system=SYSTEM, **changes):
    arguments = {"q0": Q0, "v0": V0, "ts": TS, "params": PARAMS}
    return jl.simulate(system, **(arguments | changes))


def refused(message, **changes):
    with pytest.raises(ValueError, match="^" + re.escape(message)):
        run(**changes)
