"""Inspection of a declaration: shapes by tracing, mass matrix and rows by numbers."""

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxlag._core._arrays import concrete
from jaxlag._core._errors import invalid
from jaxlag._linalg._mass_solve import known_definite
from jaxlag._lowering import Sparsity, find_sparsity, sparse_kkt
from jaxlag._model._forces import reads_lam
from jaxlag._model._inputs import evaluate
from jaxlag._model._states import named_states, state_names
from jaxlag._system._reactions import AbstractReactions
from jaxlag._tracing import _params
from jaxlag._tracing._compiled import Compiled
from jaxlag._tracing._index_check import check_indices
from jaxlag._tracing._input_values import InputValues

LEARNED = 64
"""Numbers in matrices of the params from which on a Lagrangian may be learned."""
LARGE = 64
"""Coordinates above which M is tested by its blocks first."""
INDEPENDENT = 1e-3
"""Least singular value of clearly independent rows of unit length."""


def advice_on_mass(params: Any) -> str:
    """Advice for a mass matrix that is not positive definite, if L may be learned; else ""."""
    traced, _ = _params.split(params)
    weights = [x for x in jax.tree.leaves(traced) if eqx.is_inexact_array(x) and np.ndim(x) == 2]
    if sum(np.size(x) for x in weights) < LEARNED:
        return ""
    return (
        "If L is a network, let one network return a triangular matrix F and another one V, and "
        "write L = v^T (F F^T + eps I) v / 2 - V."
    )


class Definite(NamedTuple):
    """Whether M is positive definite without the constraints; None if the params are traced.

    Attributes:
        alone: it is.
        in_blocks: the blocks of a sparse M are, with the rows inside of them.
    """

    alone: bool | None
    in_blocks: bool | None


def mass_definite(
    system: AbstractReactions, params: Any, t: Any, q: Any, v: Any, sample: _params.Sample
) -> Definite:
    """Whether M is positive definite for these params without the constraints.

    Tested in the given state, if it is known, and in one other: the mass of a link is zero
    everywhere or nowhere. If the state is traced and M depends on it, it is also tested in states
    where inertias vanish, as in polar coordinates at r = 0. Only used with constraints.

    Args:
        system: the mechanical system.
        params: as the Lagrangian takes them.
        t: time of the state.
        q: coordinates.
        v: velocities, or None.
        sample: params for the check of code for M.
    """
    if not system.constraints:
        return Definite(False, False)
    if not concrete(params):
        return Definite(None, None)
    states = _test_states(system, params, t, q, v)
    if system.size > LARGE:
        in_blocks = _in_blocks(system, params, states)
        if in_blocks is not None:
            return in_blocks
    for at in states:
        with jax.ensure_compile_time_eval():
            M = _mass((system, sample), params, None, *at)
        if not concrete(M):
            return Definite(None, None)  # the Lagrangian closes over a traced value
        if not known_definite(np.asarray(M, np.float64), q.dtype):
            return _in_blocks(system, params, states) or Definite(False, False)
    return Definite(True, True)


def _test_states(system: AbstractReactions, params: Any, t: Any, q: Any, v: Any) -> list[tuple]:
    """States where the mass matrix is tested, see `mass_definite`."""
    n = system.size
    states = [(0.0, *np.random.default_rng(0).uniform(-1.5, 1.5, (2, n)))]
    v = jnp.zeros_like(q) if v is None else v
    if concrete((t, q, v)):
        states.append((t, q, v))
    elif system._structure(params, q.dtype).mass & {"t", "q", "v"}:
        states += [(0.0, np.full(n, x), np.zeros(n)) for x in (0.0, np.pi / 2, np.pi)]
    kinds = jnp.result_type(float), q.dtype, q.dtype
    return [tuple(map(np.asarray, state, kinds)) for state in states]


def _in_blocks(system: AbstractReactions, params: Any, states: list[tuple]) -> Definite | None:
    """The same by blocks; None if M and A are not sparse."""
    dtype = states[0][1].dtype
    sparsity = find_sparsity(system._terms, params, system.size, dtype).sparsity
    if sparsity is None:
        return None
    alone = in_blocks = True
    for at in states:
        with jax.ensure_compile_time_eval():
            found = _blocks((system, sparsity), params, None, *at)
        if not concrete(found):
            return Definite(None, None)
        M, augmented = (np.asarray(x, np.float64) for x in found)
        alone = alone and known_definite(M, dtype)
        in_blocks = in_blocks and known_definite(augmented, dtype)
    return Definite(alone, in_blocks)


def contact_rows_independent(
    system: AbstractReactions,
    params: Any,
    t: Any,
    q: Any,
    v: Any,
    inputs: Mapping[str, Any],
) -> bool:
    """Whether rows whose multipliers forces read are clearly independent of one another.

    Tested in the given state; False if anything is traced.
    """
    v = jnp.zeros_like(q) if v is None else v
    if not system.constraints or not concrete(params, t, q, v, inputs):
        return False
    if not any(map(reads_lam, system.forces)):
        return True
    array = system._terms
    t, q, v = jnp.asarray(t, float), jnp.asarray(q), jnp.asarray(v)
    inputs = {k: jnp.asarray(x) if isinstance(x, np.ndarray) else x for k, x in inputs.items()}
    chosen = np.flatnonzero(array.rows_read(t, q, v, params, evaluate(inputs, t, q, v, params)))
    if len(chosen) < 2:
        return True
    with jax.ensure_compile_time_eval():
        A = np.asarray(_rows((system,), params, None, t, q, v), np.float64)[chosen]
    sizes = np.linalg.norm(A, axis=1, keepdims=True)
    if not np.all(np.isfinite(A)) or not np.all(sizes > 0):
        return False
    return bool(np.linalg.svd(A / sizes, compute_uv=False)[-1] > INDEPENDENT)


def check_traceable(
    system: AbstractReactions, params: Any, dtype: Any, values: InputValues | None
) -> None:
    """Trace L, the forces and the rates; raise if a shape or dtype is wrong.

    Args:
        system: whose functions are traced.
        params: as the Lagrangian takes them.
        dtype: of the state.
        values: values of the inputs, and of states, by name; None to leave the forces out.
    """
    t = jax.ShapeDtypeStruct((), jnp.result_type(float))
    q = v = jax.ShapeDtypeStruct((system.size,), dtype)
    traced, static = _params.split(params)
    terms = system._terms

    def all_terms(t: Array, q: Array, v: Array, traced: Any, beside: Any) -> Any:
        params = _params.join(traced, static)
        p = terms.momentum(t, q, v, params)
        if values is None:
            return p
        return p + terms.force(t, q, v, params, values.changed(beside))

    states, rest = system.states, [None for _ in jax.tree.leaves(traced)]
    if states is None or values is None:
        closed = jax.make_jaxpr(all_terms)(t, q, v, traced, {})
        check_indices(closed, [None, "q", "v", *rest])
        return

    # A fixed index is checked where it is read: of a named part by forces, of x by the rate.
    x = jax.ShapeDtypeStruct((states.size,), dtype)
    beside = jax.eval_shape(partial(named_states, states), x)
    closed = jax.make_jaxpr(all_terms)(t, q, v, traced, beside)
    names = [f"inputs[{name!r}]" if beside[name].ndim == 1 else None for name in sorted(beside)]
    check_indices(closed, [None, "q", "v", *rest, *names])

    def rates(t: Array, q: Array, v: Array, x: Array, traced: Any) -> Array:
        return states.rates_at(t, q, v, x, _params.join(traced, static), values)

    closed = jax.make_jaxpr(rates)(t, q, v, x, traced)
    check_indices(closed, [None, "q", "v", "x", *rest], "States: rate")


@Compiled
def _rows(system: AbstractReactions, params: Any, _: None, t: Array, q: Array, v: Array) -> Array:
    return system._terms.rows(t, q, v, params)[0]


@Compiled
def _mass(
    system: AbstractReactions,
    sample: _params.Sample,
    params: Any,
    _: None,
    t: Array,
    q: Array,
    v: Array,
) -> Array:
    return system._program.terms(q, params, sample).mass(t, q, v, params)


@Compiled
def _blocks(
    system: AbstractReactions,
    sparsity: Sparsity,
    params: Any,
    _: None,
    t: Array,
    q: Array,
    v: Array,
) -> tuple[Array, Array]:
    """The blocks of M, and of M + A^T W A by the rows inside of them."""
    kkt = sparse_kkt(system._terms, sparsity, params, t, q, v)
    return kkt.mass.entries, kkt.augmented()[0].entries


def check_declaration(
    system: AbstractReactions, params: Any, inputs: Mapping[str, Any], t: Array, q: Array, v: Array
) -> None:
    """Check L, the forces and the inputs by shapes and names alone; run while tracing.

    The inputs contain the values of states, if there are any.
    """
    values = evaluate(inputs, t, q, v, params)
    check_traceable(system, params, q.dtype, values)
    for name in inputs:
        if name not in values.read and name not in state_names(system.states):
            raise invalid(
                "inputs",
                "hold only signals that a declared function reads",
                f"none read {name!r}",
                "Drop it, or read inputs[name] in a GeneralizedForce.",
            )
