"""Systems with states, under both lowerings."""

import jaxlag as jl
from bench._problems.scenes import SCENES
from systems.catalogue import ENTRIES, Entry

MOVING = {name: entry for name, entry in ENTRIES.items() if isinstance(entry, Entry)}


def case(name):
    """(system, params, q0, v0)."""
    if name in MOVING:
        entry = MOVING[name]
        return entry.system, dict(entry.example.params), entry.example.q0, entry.example.v0
    scene = SCENES[name]
    names = tuple(f"q{i}" for i in range(len(scene.q0)))
    return jl.System(scene.lagrangian, names), dict(scene.params), scene.q0, scene.v0
