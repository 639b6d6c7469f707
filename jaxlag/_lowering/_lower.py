"""Lowering of a declared system to its scalar program, or to the reason why it has none."""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxlag._linalg._mass_solve import known_definite
from jaxlag._lowering._graph._expression import Node, order
from jaxlag._lowering._graph._straight_line import assemble
from jaxlag._lowering._jaxpr._from_jaxpr import Unsupported
from jaxlag._lowering._symbolic._derive import Derivation, derivation, derive, shortest_solve
from jaxlag._lowering._symbolic._program_key import Key
from jaxlag._lowering._symbolic._read_system import read_scene, with_forces
from jaxlag._lowering._symbolic._symbolic_system import Equations, SymbolicSystem
from jaxlag._lowering._term_codes import TermCodes
from jaxlag._lowering._verification._compared_accelerations import ComparedAccelerations
from jaxlag._lowering._verification._compared_rates import ComparedRates
from jaxlag._lowering._verification._compared_state import numbers, random_state
from jaxlag._lowering._verification._compared_terms import ComparedForces, ComparedTerms, TermNodes
from jaxlag._lowering._verification._verify import Verification, compare
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
# 667 ms; linkage of six bars in space in null_space (1892 in L, 3828) 13 s, 4.6 ms | 37 s, 139 ms.
OF_ARRAYS = 3

STATES = 4  # random states for the usual mass matrix
SHOWN = 3  # longest parts of code that is too long


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


@lru_cache(maxsize=256)
def lower_terms(key: Key, sample: _params.Sample) -> TermCodes | None:
    """Code for the terms of a system with constraints, verified; None if there is none.

    There is none either where coefficients of the rows may be rounding: in the code they are
    numbers, whose rounding is unknown.

    Args:
        key: `of_terms` of the key of a program.
        sample: as for `lower`.
    """
    try:
        read = _read(key)
        if read.terms is None or read.terms.cancelled:
            return None
        if not _verified(key, 0, sample).sound:
            return None
    except OutOfRange:
        raise
    except Exception:
        return None
    form, bound, graph = read.terms.forms[0], read.scene.constrained, read.scene.graph.copy()
    if bound is None or form.rows is None:
        return None
    A, gamma = form.rows
    gradients = [row for row, holonomic in zip(A, bound.holonomic, strict=True) if holonomic]
    roots = {
        "mass": [x for row in form.M for x in row],
        "bias": form.h,
        "rows": [x for row in A for x in row],
        "position_rows": [x for row in gradients for x in row],
        "gamma": gamma,
        "position": bound.position,
        "velocity": bound.velocity,
    }
    programs = {name: assemble(graph, nodes) for name, nodes in roots.items()}
    if any(program.has_rules for program in programs.values()):
        return None
    return TermCodes(programs)


@lru_cache(maxsize=256)
def usually_definite(key: Key, sample: _params.Sample) -> bool:
    """Whether M is positive definite without the constraints in one of several random states.

    True if M is finite in none of them, and if the state has quasi-velocities.

    Args:
        key: key of a program that exists.
        sample: params if they are known; otherwise they are random.
    """
    if key.quasi is not None:
        return True
    terms, n = _read(key.of_terms).terms, key.size
    assert terms is not None
    rng, flat = np.random.default_rng(0), [x for row in terms.forms[0].M for x in row]
    states = [random_state(key, rng, sample.leaves) for _ in range(STATES)]
    masses = [numbers(flat, at).reshape(n, n) for at in states]
    known = [M for M in masses if np.all(np.isfinite(M))]
    return not known or any(known_definite(M, key.dtype) for M in known)


def _lowered(key: Key, sample: _params.Sample) -> Lowered:
    eps = float(jnp.finfo(key.dtype).eps)
    try:
        if key.quasi is not None:
            read = _read(key)
            scene = read.scene
        else:
            read = _read(key.of_terms)
            scene = with_forces(read.scene, key)
        reason = read.reason or _too_long(scene, key, read.limit)
        if reason is not None:
            return Lowered(None, reason, scene)
        equations, form = derive(scene, read.terms, eps)
    except Unsupported as unsupported:
        return Lowered(None, str(unsupported), None)
    operations, once = equations.program.operations, len(equations.program.prelude)
    if read.limit is not None and operations + once > read.limit:
        found = f"{operations} operations, {once} more once per solve: more than {read.limit}"
        return Lowered(None, f"{found}; {_longest(scene, equations)}", scene)
    if read.terms is None:
        verified = compare(key, ComparedRates(key, equations), sample.leaves)
    else:
        nodes, force = _nodes(read, form), scene.force or ()
        verified = _verified(key.of_terms, form, sample)
        accelerations = ComparedAccelerations(key, nodes, force, equations.accelerations)
        verified = verified.and_of(compare(key, accelerations, sample.leaves))
        if force:
            forces = ComparedForces(key, force)
            verified = verified.and_of(compare(key, forces, sample.leaves))
    return Lowered(equations if verified.sound else None, verified.message, scene)


class _Read(NamedTuple):
    """A system as scalars, and its terms.

    Attributes:
        scene: the system, without forces unless its state has quasi-velocities.
        limit: largest number of operations of a scalar program; None for no limit.
        terms: M, h, A and gamma; None with quasi-velocities.
        reason: why there is no scalar program; None if there may be one.
    """

    scene: SymbolicSystem
    limit: int | None
    terms: Derivation | None = None
    reason: str | None = None


@lru_cache(maxsize=256)
def _read(key: Key) -> _Read:
    """The terms of a system, for all forces and all ways to solve for accelerations.

    Raises:
        Unsupported: there is no scalar program.
    """
    scene = read_scene(key)
    limit = None if key.limit is None else max(key.limit, OF_ARRAYS * scene.array_operations)
    reason = _too_long(scene, key, limit)
    if reason is None and limit is not None and (least := shortest_solve(scene)) > limit:
        reason = f"at least {least} operations, more than {limit}"
    if reason is not None:
        return _Read(scene, limit, reason=reason)
    return _Read(scene, limit, None if key.quasi is not None else derivation(scene, limit))


def _nodes(read: _Read, form: int) -> TermNodes:
    """The terms in one form."""
    assert read.terms is not None
    terms, bound = read.terms.forms[form], read.scene.constrained
    residuals = [] if bound is None else [*bound.position, *bound.velocity]
    return TermNodes(terms.M, terms.h, terms.rows, residuals)


@lru_cache(maxsize=256)
def _verified(key: Key, form: int, sample: _params.Sample) -> Verification:
    """The comparison of the terms in one form with the array program."""
    return compare(key, ComparedTerms(key, _nodes(_read(key), form)), sample.leaves)


def _too_long(scene: SymbolicSystem, key: Key, limit: int | None) -> str | None:
    """Why L and Q are better on arrays; None if they may not be."""
    if key.limit is not None and (units := _units(scene)) > UNITS:
        return f"{units} functions of weighted sums, more than {UNITS}"
    if limit is not None and (written := _written(scene)) > 2 * limit:
        return f"{written} operations in L and Q alone"
    return None


def _longest(scene: SymbolicSystem, equations: Equations) -> str:
    """The longest parts, with their operations before equal ones are computed once."""
    parts = {"M": [x for row in equations.mass for x in row], "h": equations.bias}
    if scene.kinematics is not None:
        parts = {"B^T M B": parts["M"], "B^T (h - Q)": parts["h"]}
    parts["Q"] = [*(scene.force or ()), *((scene.constrained and scene.constrained.reaction) or ())]
    if equations.rows is not None and scene.constrained is not None:
        for name, row, gamma in zip(scene.constrained.labels, *equations.rows, strict=True):
            parts[f"row {name!r}"] = [*row, gamma]
    sizes = {name: _operations(nodes) for name, nodes in parts.items()}
    longest = sorted(filter(sizes.get, sizes), key=lambda name: -sizes[name])[:SHOWN]
    return ", ".join(f"{name} {sizes[name]}" for name in longest)


def _written(scene: SymbolicSystem) -> int:
    """Operations of varying parts in L and Q, as they are written."""
    return _operations([scene.lagrangian, *(scene.force or ())])


def _operations(nodes: Sequence[Node]) -> int:
    """Operations of varying nodes."""
    return sum(max(len(node.args) - 1, 1) for node in order(nodes) if node.args and not node.fixed)


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
