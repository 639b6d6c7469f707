"""Stages of explicit methods: unrolled, in Nystrom's form, and in a loop."""

from collections.abc import Sequence
from functools import reduce
from typing import Any, NamedTuple

import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jaxlag._core._arrays import elements
from jaxlag._core._xla import opaque_one
from jaxlag.solvers._second_order import second_order_form
from jaxlag.solvers._tableau import Tableau
from jaxlag.solvers._unweighted_stages import unseen, unstacked


class Attempt(NamedTuple):
    """One step.

    Attributes:
        y1: the state at its end.
        error: h sum_i e_i k_i.
        unseen: error of unweighted stages; None for methods without such stages.
        k: h dy/dt at every stage.
        last: dy/dt at the last stage, if steps share it.
    """

    y1: Any
    error: Any
    unseen: Any
    k: Any
    last: Any


def _added(y: Any, change: Any) -> Any:
    return jax.tree.map(jnp.add, y, change)


def _scaled(factor: Any, x: Any) -> Any:
    if isinstance(factor, float) and factor == 1.0:
        return x
    return jax.tree.map(lambda x: factor * x, x)


def _sum(weights: np.ndarray, k: Sequence[Any]) -> Any:
    """sum_j weights_j k_j."""
    used = [(float(w), stage) for w, stage in zip(weights, k, strict=False) if w != 0.0]

    def total(*parts: Array) -> Array:
        out = used[0][0] * parts[0]
        for (w, _), part in zip(used[1:], parts[1:], strict=True):
            out = out + w * part
        return out

    return jax.tree.map(total, *(stage for _, stage in used))


def _first(terms: Any, t0: Any, y0: Any, known: Any, fresh: Any, args: Any) -> Any:
    """dy/dt at the first stage."""
    if fresh is True:
        return terms.vf(t0, y0, args)
    if fresh is False:
        return known
    return lax.cond(fresh, lambda _: terms.vf(t0, y0, args), lambda k: k, known)


def _kept(x: list[Array]) -> list[Array]:
    """The same numbers, each loaded from its array once."""
    one = opaque_one(x[0].dtype)
    return [number / one for number in x]


def written_out(
    tableau: Tableau, terms: Any, t0: Any, t1: Any, y0: Any, known: Any, fresh: Any, args: Any
) -> Attempt:
    """An unrolled step."""
    per_step = lax.optimization_barrier(1.0 / terms.contr(t0, t1))
    lanes = getattr(terms, "in_lanes", False)

    def parts(y: Any) -> Any:
        return elements(y) if lanes else y

    def joined(y: Any) -> Any:
        return jnp.stack(y) if lanes else y

    def increments(rates: Any) -> Any:
        """All later stages read them: they end in divisions, which XLA computes once."""
        return jax.tree.map(lambda x: x / per_step, parts(rates))

    first = _first(terms, t0, y0, known, fresh, args)
    y = parts(y0)
    k, stage, last = [increments(first)], y, None
    for row, c in zip(tableau.velocity_rows, tableau.c, strict=True):
        t = t1 if c == 1.0 else t0 + float(c) * (t1 - t0)
        stage = _added(y, _sum(row, k))
        last = terms.vf(t, joined(stage), args)
        k.append(increments(last))
    if not tableau.fsal:
        stage, last = _added(y, _sum(tableau.b, k)), None
    beside = joined(unseen(k, tableau.unweighted)) if tableau.unweighted else None
    stages = jax.tree.map(lambda *x: jnp.stack(x), *map(joined, k))
    return Attempt(joined(stage), joined(_sum(tableau.e, k)), beside, stages, last)


def nystrom(
    tableau: Tableau, terms: Any, t0: Any, t1: Any, y0: Any, known: Any, fresh: Any, args: Any
) -> Attempt:
    """The same of second-order equations, y = (q, v)."""
    h, form = terms.contr(t0, t1), second_order_form(terms)
    per_step = lax.optimization_barrier(1.0 / h)

    def parts(y: Any) -> Any:
        q, v = form.parts(y)
        return (elements(q), elements(v)) if form.in_lanes else (q, v)

    def joined(q: Any, v: Any) -> Any:
        return jnp.stack([*q, *v]) if form.in_lanes else form.joined(q, v)

    first = _first(terms, t0, y0, known, fresh, args)
    y, kick = parts(y0), parts(first)[1]
    if form.in_lanes:
        y, kick = tuple(map(_kept, y)), _kept(kick)
    kicks, rates, last = [kick], [first], None

    def gain(row: np.ndarray, squared: np.ndarray, c: float) -> Any:
        """The changes of q and v, over h."""
        drifts = [] if c == 0.0 else [_scaled(c, y[1])]
        if np.any(squared):
            drifts.append(_scaled(h, _sum(squared, kicks)))
        return form.signed(reduce(_added, drifts), args), _sum(row, kicks)

    def whole(gain: Any) -> Any:
        """h times it. The results of a step have many uses: XLA computes divisions once."""
        return jax.tree.map(lambda x: x / per_step, gain)

    def soon(squared: np.ndarray, c: float) -> Any:
        """A stage without velocity. The last acceleration comes in by one product and sum."""
        *before, newest = squared[: len(kicks)]
        drift = _scaled(c, y[1])
        if np.any(before):
            drift = _added(drift, _scaled(h, _sum(np.array(before), kicks)))
        early = _added(y[0], form.signed(_scaled(h, drift), args))
        return _added(early, form.signed(_scaled(h * h * newest, kicks[-1]), args)), y[1]

    rows = [None] * len(tableau.c) if tableau.rows is None else tableau.rows
    for i, (row, squared, c) in enumerate(zip(rows, tableau.rows_squared, tableau.c, strict=True)):
        t = t1 if c == 1.0 else t0 + float(c) * (t1 - t0)
        if row is None:
            stage = soon(squared, float(c))
        elif tableau.fsal and i + 1 == len(tableau.c):
            stage = _added(y, whole(gain(row, squared, 1.0)))
        else:
            stage = _added(y, _scaled(h, gain(row, squared, float(c))))
        last = terms.vf(t, joined(*stage), args)
        kicks.append(parts(last)[1])
        rates.append(last)
    if not tableau.fsal:
        stage, last = _added(y, whole(gain(tableau.b, tableau.b_squared, 1.0))), None
    if tableau.rows is None:  # the rates at the end of the step
        rates[-1] = joined(form.signed(stage[1], args), kicks[-1])
    # The weights of the error estimate have the sum 0: the velocity at the start drops out.
    error, beside = whole(gain(tableau.e, tableau.e_squared, 0.0)), None
    if tableau.unweighted:
        nothing = jax.tree.map(jnp.zeros_like, y[0])
        beside = joined(nothing, whole(unseen(kicks, tableau.unweighted)))
    k = jax.tree.map(lambda *x: h * jnp.stack(x), *rates)
    return Attempt(joined(*stage), joined(*error), beside, k, last)


def nystrom_in_loop(
    tableau: Tableau, terms: Any, t0: Any, t1: Any, y0: Any, known: Any, fresh: Any, args: Any
) -> Attempt:
    """The same of accelerations that do not depend on v, which are once in the program."""
    del known, fresh  # No stage is shared.
    h, form, size = terms.contr(t0, t1), second_order_form(terms), len(tableau.c) + 1
    rows = np.concatenate([np.zeros((1, size)), tableau.rows_squared])
    nodes = np.concatenate([[0.0], tableau.c])
    q, v = form.parts(y0)

    def drift(weights: Any, kicks: Any, c: Any) -> Any:
        """h (c v + h sum_j weights_j kicks_j)."""
        sums = _sums(h, weights, kicks)
        return form.signed(jax.tree.map(lambda v, x: h * (c * v + x), v, sums), args)

    def stage(i: Array, kicks: Any) -> Any:
        c = _entry(nodes, i).astype(t0.dtype)
        y = form.joined(_added(q, drift(_entry(rows, i), kicks, c.astype(h.dtype))), v)
        return _put(kicks, i, form.parts(terms.vf(t0 + c * (t1 - t0), y, args))[1])

    none = jax.tree.map(lambda v: jnp.zeros((size, *v.shape), v.dtype), v)
    kicks = lax.fori_loop(0, size, stage, none)
    q1 = _added(q, drift(tableau.b_squared, kicks, 1.0))
    v1 = _added(v, _sums(h, tableau.b, kicks))
    error = form.joined(drift(tableau.e_squared, kicks, 0.0), _sums(h, tableau.e, kicks))
    changes = jax.tree.map(lambda x: h * x, kicks)
    beside = unseen(unstacked(changes), tableau.unweighted) if tableau.unweighted else None
    if beside is not None:
        beside = form.joined(jax.tree.map(jnp.zeros_like, q), beside)
    drifts = jax.tree.map(lambda v, v1: jnp.stack([*[v] * (size - 1), v1]), v, v1)
    drifts = jax.tree.map(lambda x: h * x, form.signed(drifts, args))
    k = jax.vmap(form.joined)(drifts, changes)
    return Attempt(form.joined(q1, v1), error, beside, k, None)


def in_loop(
    tableau: Tableau, terms: Any, t0: Any, t1: Any, y0: Any, known: Any, fresh: Any, args: Any
) -> Attempt:
    """The same, with dy/dt once in the program."""
    h, size = terms.contr(t0, t1), len(tableau.c) + 1
    rows = np.concatenate([np.zeros((1, size)), tableau.velocity_rows])
    nodes = np.concatenate([[0.0], tableau.c])
    traced = not isinstance(fresh, bool)

    def stage(i: Array, carry: tuple[Any, Any]) -> tuple[Any, Any]:
        k, _ = carry
        y = _added(y0, _sums(h, _entry(rows, i), k))
        rates = terms.vf(t0 + _entry(nodes, i).astype(t0.dtype) * (t1 - t0), y, args)
        if traced:
            rates = jax.tree.map(lambda x, k: jnp.where((i > 0) | fresh, x, k), rates, known)
        return _put(k, i, rates), y

    k = jax.tree.map(lambda y: jnp.zeros((size, *y.shape), y.dtype), y0)
    begin: Any = 0
    if fresh is not True:
        k = jax.tree.map(lambda k, x: k.at[0].set(x), k, known)
        # One bound for all lanes.
        begin = jnp.where(eqxi.unvmap_any(fresh), 0, 1) if traced else 1
    k, last_stage = lax.fori_loop(begin, size, stage, (k, y0))
    if tableau.fsal:
        y1, last = last_stage, jax.tree.map(lambda x: x[-1], k)
    else:
        y1, last = _added(y0, _sums(h, tableau.b, k)), None
    increments = jax.tree.map(lambda x: h * x, k)
    beside = unseen(unstacked(increments), tableau.unweighted) if tableau.unweighted else None
    return Attempt(y1, _sums(h, tableau.e, k), beside, increments, last)


def _entry(table: np.ndarray, i: Array) -> Array:
    """Entry i along the first axis."""
    return lax.dynamic_index_in_dim(jnp.asarray(table), i, keepdims=False)


def _put(k: Any, i: Array, stage: Any) -> Any:
    """The stages with stage i written."""
    return jax.tree.map(lambda k, x: lax.dynamic_update_index_in_dim(k, x, i, 0), k, stage)


def _sums(h: Array, weights: Any, k: Any) -> Any:
    """h sum_j weights_j k_j, along the first axes."""

    def total(x: Array) -> Array:
        wide = jnp.asarray(weights).reshape((-1,) + (1,) * (x.ndim - 1)).astype(x.dtype)
        return h * jnp.sum(wide * x, axis=0)

    return jax.tree.map(total, k)
