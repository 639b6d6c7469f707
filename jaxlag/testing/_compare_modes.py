"""Derivatives of a declared function in every mode, and their differences.

A function f of (t, q, v, params) is reduced to g = w . f with a dense random w, along a dense
random direction d of all its arguments: D^k g = d^k/ds^k g(z + s d) contains every partial
derivative of order k. One nonfinite derivative makes the sum nonfinite.
"""

from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun

from jaxlag._system import _nan_origins
from jaxlag._system._declared_functions import Declared
from jaxlag._system._nan_origins import Origin, TracedProgram

VALUE, FORWARD, REVERSE, TWICE = "value", "forward", "reverse", "reverse twice"


# ---- Derivatives of one function --------------------------------------------------------------


def dot(a: Any, b: Any) -> Array:
    """Sum of the products of all entries of two pytrees."""
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    kind = jnp.result_type(float)
    return sum((jnp.sum((x * y).astype(kind)) for x, y in pairs), jnp.zeros((), kind))


class Derivatives:
    """Derivatives of a scalar function g(z) by some of its arguments, along d, as programs.

    Each is traced from the program of the order below: to differentiate it in one pass would
    trace g 2^k times.

    Args:
        g: function of a dict of arrays.
        z: the dict; only shapes and dtypes are used.
        active: names of the arguments; the others are held constant.
    """

    def __init__(self, g: Callable, z: Mapping[str, Any], active: Sequence[str]) -> None:
        self._g, self._z, self._active = g, z, active
        self._programs: dict[tuple, tuple[ClosedJaxpr, Any]] = {}

    def program(self, mode: str, order: int, lanes: int = 0) -> tuple[ClosedJaxpr, Any]:
        """A derivative as a program of the leaves of (z, d), and the structure of its results.

        Args:
            mode: FORWARD, D^k g; REVERSE, the gradient of D^(k-1) g, with the reverse derivative
                taken first; TWICE, the same with a reverse derivative first and last, as for
                motions; VALUE at order 0.
            order: k.
            lanes: length of a first axis of all leaves, under vmap; 0 for none.
        """
        key = (mode, order, lanes)
        if key not in self._programs:
            if lanes:
                below = self._called(mode, order)
                z = jax.tree.map(lambda x: jnp.stack([x] * lanes), self._z)
                self._programs[key] = _traced(jax.vmap(below), z, z)
            else:
                self._programs[key] = _traced(self._derivative(mode, order), self._z, self._z)
        return self._programs[key]

    def _derivative(self, mode: str, order: int) -> Callable:
        def some(z: Any) -> dict[str, Any]:
            return {name: z[name] for name in self._active}

        if order == 0:
            return lambda z, d: self._g(z)
        if mode == REVERSE and order == 1:
            return lambda z, d: jax.grad(lambda x: self._g({**z, **x}))(some(z))
        if mode == TWICE:
            below = self._called(REVERSE, order - 1)
            return lambda z, d: jax.grad(lambda x: dot(below({**z, **x}, d), some(d)))(some(z))
        below = self._called(mode if order > 1 else VALUE, order - 1)
        return lambda z, d: jax.jvp(lambda x: below({**z, **x}, d), (some(z),), (some(d),))[1]

    def _called(self, mode: str, order: int) -> Callable:
        closed, tree = self.program(mode, order)
        run = jaxpr_as_fun(closed)
        return lambda z, d: jax.tree.unflatten(tree, run(*jax.tree.leaves((z, d))))


def _traced(function: Callable, *args: Any) -> tuple[ClosedJaxpr, Any]:
    closed, shape = jax.make_jaxpr(function, return_shape=True)(*args)
    return closed, jax.tree.structure(shape)


class Ladder:
    """A declared function with its derivatives of every order and mode.

    Attributes:
        groups: its arguments for the derivatives.
        program: the function.
        steps: (mode, order), lower orders first.
        omitted: why a mode is omitted, if one is.
    """

    def __init__(self, function: Declared, z: Mapping[str, Any]) -> None:
        self.groups = [name for name in function.arguments if jax.tree.leaves(z[name])]
        self._names = {*function.arguments, "params"}
        self._example = self._own(z)
        self.program = TracedProgram(function.function, self._example)
        self._weights = dense(np.random.default_rng(0), self.program.closed.out_avals[0].shape)
        self._by: dict[tuple[str, ...], Derivatives] = {}
        modes, self.omitted = [FORWARD, REVERSE, TWICE], ""
        if self.program.contains("while", "custom_vmap_call"):
            modes, self.omitted = [FORWARD], "no reverse derivatives: a while loop or custom_vmap"
        orders = range(1, function.role.order + 2)
        self.steps = [(VALUE, 0)]
        self.steps += [(m, k) for k in orders for m in modes if m != TWICE or k > 1]

    def values(self, z: Any, d: Any, lanes: int = 0) -> dict[tuple[str, int], Any]:
        """Every derivative at (z, d), or under vmap at many pairs along a first axis."""
        return {step: self._value(*step, tuple(self.groups), z, d, lanes) for step in self.steps}

    def origins(
        self, mode: str, order: int, z: Any, d: Any, *, vmapped: bool
    ) -> list[tuple[Origin, str]]:
        """(operation, variables): the origin of a nonfinite derivative, and its variables.

        With as few of the arguments as necessary, all others constant.

        Args:
            mode: mode of the derivative.
            order: order of the derivative.
            z: the state.
            d: the direction.
            vmapped: whether to evaluate it under vmap.
        """
        if vmapped:
            z, d = jax.tree.map(lambda x: x[None], (z, d))
        for count in range(min(order, 1), len(self.groups) + 1):
            found: dict[Origin, list[str]] = {}
            for active in combinations(self.groups, count):
                if finite(self._value(mode, order, active, z, d, int(vmapped))):
                    continue
                program, _ = self._derivatives(active).program(mode, order, int(vmapped))
                origins = self.program.origins(program, self._own(z), self._own(d))
                for origin in origins or [Origin("")]:
                    found.setdefault(origin, []).append(" and ".join(active))
            if found:
                return [(origin, " or ".join(names)) for origin, names in found.items()]
        return [(Origin(""), "")]

    def _value(
        self, mode: str, order: int, active: tuple[str, ...], z: Any, d: Any, lanes: int
    ) -> Any:
        closed, tree = self._derivatives(active).program(mode, order, lanes)
        leaves = jax.tree.leaves((self._own(z), self._own(d)))
        return jax.tree.unflatten(tree, _nan_origins.evaluate(closed, *leaves))

    def _derivatives(self, active: tuple[str, ...]) -> Derivatives:
        if active not in self._by:
            self._by[active] = Derivatives(self._weighted, self._example, active)
        return self._by[active]

    def _weighted(self, z: Mapping[str, Any]) -> Array:
        out = self.program(z)
        return jnp.sum(out * jnp.asarray(self._weights, out.dtype))

    def _own(self, z: Mapping[str, Any]) -> dict[str, Any]:
        return {name: z[name] for name in self._names}


def finite(value: Any) -> bool:
    """Whether all numbers of a pytree are finite."""
    return all(np.all(np.isfinite(x)) for x in jax.tree.leaves(value))


def dense(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Random numbers of either sign with sizes between 1/2 and 1: none is close to zero."""
    return np.asarray(rng.uniform(0.5, 1.0, shape) * rng.choice([-1.0, 1.0], shape))


# ---- Derivatives compared ---------------------------------------------------------------------


class Mismatch(NamedTuple):
    """Two different values of one derivative.

    Attributes:
        order: order of the derivative.
        mode: mode of the derivative that is compared.
        against: the mode or quotient that it is compared with.
        value: of the derivative along d.
        other: the value that it is compared with.
    """

    order: int
    mode: str
    against: str
    value: float
    other: float


# Modes differ by the rounding of their sums: by at most 15 eps of the largest terms among the
# catalog's systems. 2^10 eps leaves room for longer programs; a wrong rule is far outside.
MODES_DIFFER = 2.0**10
# The error of the extrapolated quotient is O(h^2) of its correction, which is h^2 f'''/8. A larger
# one is not smooth: a jump at the center is 7 corrections, an infinite slope 11 or so.
CORRECTIONS = 30.0
# Rounding of the values, weighted by (8 + 1)/3h: at most 0.4 eps/h of the largest terms among the
# catalog's systems, in addition to the correction above.
ROUNDINGS = 2.0**6


def step(eps: float) -> float:
    """h of the extrapolated quotient: truncation h^4 meets rounding eps/h."""
    return eps**0.2


def mismatch(
    at: Mapping[tuple[str, int], Any],
    around: Sequence[Mapping[tuple[str, int], Any]],
    d: Any,
    eps: float,
) -> Mismatch | None:
    """The first derivative that differs from other modes, or from differences of the order below.

    Args:
        at: every derivative at a state where all are finite.
        around: the same at z + s h d for s = 1, -1, 1/2, -1/2.
        d: the direction.
        eps: eps of the precision.
    """
    h, scale, below = step(eps), 0.0, [float(x[VALUE, 0]) for x in (at, *around)]
    scale = abs(below[0])
    for order in range(1, 1 + max(order for _, order in at)):
        modes = [mode for mode in (FORWARD, REVERSE, TWICE) if (mode, order) in at]
        values = {mode: _along_d(at[mode, order], d) for mode in modes}
        scale = max([scale, *(_size(at[mode, order], d) for mode in modes)])
        first = modes[0]
        for mode in modes[1:]:
            if abs(values[mode] - values[first]) > MODES_DIFFER * eps * scale:
                return Mismatch(order, mode, first, values[mode], values[first])
        quotient, doubt = _quotient(below, h)
        if abs(values[first] - quotient) > doubt + ROUNDINGS * eps * scale / h:
            against = "difference quotient"
            return Mismatch(order, first, against, values[first], quotient)
        below = [_along_d(x[first, order], d) for x in (at, *around)]
    return None


def _quotient(values: Sequence[float], h: float) -> tuple[float, float]:
    """(central quotient extrapolated to h = 0, its uncertainty if the function is not smooth)."""
    at, up, down, near_up, near_down = values
    if not np.all(np.isfinite(values)):
        return 0.0, np.inf
    wide, narrow = (up - down) / (2 * h), (near_up - near_down) / h
    # One-sided slopes differ by h f'' if f is smooth, and by the jump of f' at a kink.
    jump = abs(4 * (near_up - 2 * at + near_down) - (up - 2 * at + down)) / h
    correction = (narrow - wide) / 3
    return narrow + correction, CORRECTIONS * abs(correction) + jump


def _along_d(value: Any, d: Any) -> float:
    """D^k g; a reverse derivative is its gradient in the last direction."""
    if not isinstance(value, dict):
        return float(value)
    return float(sum(np.sum(x * y) for x, y in _pairs(value, d)))


def _size(value: Any, d: Any) -> float:
    if not isinstance(value, dict):
        return abs(float(value))
    return float(sum(np.sum(np.abs(x * y)) for x, y in _pairs(value, d)))


def _pairs(value: dict, d: Mapping[str, Any]) -> Any:
    own = {name: d[name] for name in value}
    return zip(jax.tree.leaves(value), map(np.asarray, jax.tree.leaves(own)), strict=True)
