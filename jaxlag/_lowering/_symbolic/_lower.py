"""Lowering of a declared system to its scalar program, or to the reason why it has none."""

from functools import lru_cache
from typing import NamedTuple

import jax.numpy as jnp

from jaxlag._lowering._graph._expression import Node, order
from jaxlag._lowering._jaxpr._from_jaxpr import Unsupported
from jaxlag._lowering._symbolic._derive import derive
from jaxlag._lowering._symbolic._program_key import Key
from jaxlag._lowering._symbolic._read_system import read_scene
from jaxlag._lowering._symbolic._symbolic_system import Equations, SymbolicSystem
from jaxlag._lowering._symbolic._verify import compare
from jaxlag._tracing import _params
from jaxlag._tracing._index_check import OutOfRange

# Largest number of operations, those once per solve included, and of functions of weighted sums
# (network units) for which "auto" takes the scalar program. Seconds of tracing and compiling a
# solve of order 8, and milliseconds of its run, scalar | array. Chains of 8 links: 2.4, 0.42 |
# 1.8, 1.1; of 10: 3.8,
# 0.75 | 1.6, 2.6; of 12 (1636 operations): 5.9, 1.3 | 1.8, 4.5; of 16: 10, 2.9 | 1.9, 9.8. Five
# bodies: 1.5, 0.34 | 1.4, 3.5. A full stiffness matrix of 16 coordinates (816): 2.5, 0.14 | 0.75,
# 0.30; of 24 (1800): 5.6, 0.22 | 1.8, 0.80; full constant matrices of mass and stiffness of 12
# (1553): 7.0, 0.32 | 1.2, 0.30. Networks of 4 inputs, 8 units: 1.1, 0.10 | 0.6, 0.10; 16 units:
# 2.4, 0.21 | 0.8, 0.14; 24 units: 4.0, 0.33 | 0.8, 0.12; 32 units (1648): 9.9, 0.47 | 0.8, 0.12.
OPERATIONS = 1500
UNITS = 15

# The same for each operation on arrays in L. The array program has about 7 of them for each one of
# L, and each takes longer to compile than a line of scalar code. First result, next ones, scalar |
# array: bicycle of four bodies by poses (2076 in L, 3023 scalar operations) 70 s, 10 ms | 134 s,
# 667 ms.
OF_ARRAYS = 2


class Lowered(NamedTuple):
    """The scalar program of a system, or why there is none.

    Attributes:
        equations: M, h and the code for a; None if the array program is used.
        reason: why there is no scalar program, or the result of its comparison, as text.
        scene: L and Q as nodes.
    """

    equations: Equations | None
    reason: str
    scene: SymbolicSystem | None


@lru_cache(maxsize=256)
def lower(key: Key, sample: _params.Sample) -> Lowered:
    """The scalar program for a key, verified against the array program.

    After any failure the array program is used; it also reports errors of the declaration.

    Args:
        key: key of the program.
        sample: params for the comparison if they are known; otherwise they are random.
    """
    try:
        return _lowered(key, sample)
    except OutOfRange:
        raise
    except Exception as error:
        message = (str(error) or "no message").splitlines()[0]
        return Lowered(None, f"no scalar program: {type(error).__name__}: {message}", None)


def _lowered(key: Key, sample: _params.Sample) -> Lowered:
    try:
        scene = read_scene(key)
        if key.limit is not None and (units := _units(scene)) > UNITS:
            return Lowered(None, f"{units} functions of weighted sums, more than {UNITS}", scene)
        limit = None if key.limit is None else max(key.limit, OF_ARRAYS * scene.array_operations)
        if limit is not None and (written := _written(scene)) > 2 * limit:
            return Lowered(None, f"{written} operations in L and Q alone", scene)
        equations = derive(scene, float(jnp.finfo(key.dtype).eps), limit)
    except Unsupported as unsupported:
        return Lowered(None, str(unsupported), None)
    operations, once = equations.program.operations, len(equations.program.prelude)
    if limit is not None and operations + once > limit:
        found = f"{operations} operations, {once} more once per solve: more than {limit}"
        return Lowered(None, found, scene)
    compared = compare(key, scene, equations, sample.leaves)
    return Lowered(equations if compared.sound else None, compared.message, scene)


def _written(scene: SymbolicSystem) -> int:
    """Operations of varying parts in L and Q, as they are written."""
    roots = [scene.lagrangian, *(scene.force or ())]
    return sum(max(len(node.args) - 1, 1) for node in order(roots) if not node.fixed)


def _units(scene: SymbolicSystem) -> int:
    """Number of functions of weighted sums, as in networks: matrix products are faster for them."""
    return sum(
        node.op == "call" and _weighted(node.args[0])
        for node in order([scene.lagrangian, *(scene.force or ())])
    )


def _weighted(node: Node) -> bool:
    """Whether this is a sum of two or more variables, each times a number or a parameter."""
    if node.op != "sum":
        return False
    moving = [(term, weight) for term, weight in node.data[1] if not term.fixed]
    if len(moving) == 1:  # a sum plus a bias
        return _weighted(moving[0][0])
    return len(moving) > 1 and all(
        abs(weight) != 1.0
        or (term.op == "product" and any(factor.fixed for factor, _ in term.data))
        for term, weight in moving
    )
