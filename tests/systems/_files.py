"""Reference files for tests: one from a closed form, one from a replayed motion."""

import numpy as np

from systems.catalogue import AbstractEntry, find
from systems.reference._check import Motion


def harmonic(*, m=1.3, k=20.0, x0=0.4, v0=0.5, times=(0.0, 0.4, 0.9, 1.3, 2.0, 2.5)):
    """A file of mass_spring by its closed form, from (x0, v0) at the first of the times."""
    entry = find("mass_spring")
    x, v = map(np.asarray, entry.exact(np.asarray(times) - times[0], x0, v0, {"m": m, "k": k}))
    T, V = 0.5 * m * v**2, 0.5 * k * x**2
    quantities = {
        "q": x[:, None],
        "v": v[:, None],
        "a": (-k / m * x)[:, None],
        "energy.T": T,
        "energy.V": V,
        "energy.E": T + V,
        "extras.H": T + V,
        "extras.p": (m * v)[:, None],
        "extras.p_dot": (-k * x)[:, None],
    }
    return _file(entry, {"m": m, "k": k}, times, quantities)


def recorded(entry: AbstractEntry, times, motion: Motion):
    """A file of the entry's example with every quantity of an already replayed case."""
    quantities = {name: np.asarray(values) for name, values in motion.values.items()}
    if entry.kind == "static":
        quantities = {name: values[0] for name, values in quantities.items()}
    params = {name: np.asarray(value).tolist() for name, value in entry.example.params.items()}
    return _file(entry, params, times, quantities)


def _file(entry: AbstractEntry, params, times, quantities):
    """A file with one case, with the fields and groups of its kind."""
    kind = entry.kind
    case = {
        "name": "base",
        "description": "made on the spot",
        "params": params,
        "error_estimate": 1e-14 if kind == "static" else {"q": 1e-14, "v": 1e-14},
    }
    if kind != "static":
        case |= {"times": list(times), "extras": {}}
    if kind == "trajectory":
        case |= {"u": None, "lambda": None, "constraint_force": None}
        case |= {"energy": {}, "invariants": {}}
    for field, values in quantities.items():
        group, _, member = field.rpartition(".")
        (case[group] if group else case)[member] = values.tolist()
    return {
        "schema": "jaxlag-reference/1",
        "system": entry.name,
        "kind": kind,
        "coordinates": list(entry.file_coordinates),
        "quasi_velocities": list(entry.quasi_velocities),
        "constraints": list(entry.file_constraints),
        "cases": [case],
    }
