"""From a declared system to its scalar program, or to the reason why it has none."""

from functools import lru_cache
from typing import NamedTuple

import jax.numpy as jnp

from jaxlag import _params
from jaxlag._lowering._compare import SLACK, STATES, compare
from jaxlag._lowering._derive import derive
from jaxlag._lowering._ingest import Unsupported
from jaxlag._lowering._key import Key
from jaxlag._lowering._read import read_scene
from jaxlag._lowering._scene import Equations, Scene

OPERATIONS = 1500  # beyond, compiling takes longer than the array program loses


class Lowered(NamedTuple):
    """The scalar program of a system, or why there is none.

    Attributes:
        equations: M, h and the code for a; None where the array program is used.
        reason: in words, why there is no scalar program, or how it compared.
        scene: L and Q as nodes.
    """

    equations: Equations | None
    reason: str
    scene: Scene | None


@lru_cache(maxsize=256)
def lower(key: Key, sample: _params.Sample) -> Lowered:
    """The scalar program for a key; compared with the array program before it is used.

    Args:
        key: what it is made for.
        sample: params to compare with where they are known, else random ones are used.
    """
    try:
        scene = read_scene(key)
        equations = derive(scene, float(jnp.finfo(key.dtype).eps), key.limit)
    except Unsupported as unsupported:
        return Lowered(None, str(unsupported), None)
    operations = equations.program.operations
    if key.limit is not None and operations > key.limit:
        return Lowered(None, f"{operations} operations, more than {key.limit}", scene)
    compared, difference = compare(key, equations, sample.leaves)
    if not difference <= 1.0:
        found = f"differs from the array program by {SLACK * difference:.1e} roundings"
        return Lowered(None, found, scene)
    words = f"equal to the array program at {compared} of {STATES} random states"
    return Lowered(equations, words, scene)
