"""An erratum of the book: the printed and the right formula, compared with the engine."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from jaxlag import energy
from systems.catalogue._entry import Entry

DRAWS = 4
"""States at which every formula is evaluated."""

_SEED = 0


class State(NamedTuple):
    """A state at which a formula is evaluated.

    Attributes:
        t: time [s].
        q: coordinates, shape (n,).
        v: generalized velocities, shape (n,).
        a: accelerations, shape (n,); those of any motion, not of the free one.
        params: parameter name -> value.
    """

    t: Any
    q: Any
    v: Any
    a: Any
    params: Mapping[str, Any]

    def values(self, *names: str) -> tuple[Any, ...]:
        """The parameters of these names."""
        return tuple(self.params[name] for name in names)


Formula = Callable[[State], ArrayLike | Sequence[float]]
"""A number or a vector at one state."""

Draw = Callable[[np.random.Generator], State]
"""A random state."""

Numbers = float | Sequence[float] | np.ndarray
"""One number for all coordinates, or one for each."""


@dataclass(frozen=True, kw_only=True)
class Erratum:
    """An error in the book.

    Attributes:
        place: number of the equation, and its subject.
        wrong: the error.
        draw: random states at which to compare.
        engine: the value that `jaxlag` computes from positions, energies and forces alone.
        printed: the book's formula for it.
        right: the corrected formula for it.
        singular: whether the printed formula is not finite at these states.
    """

    place: str
    wrong: str
    draw: Draw
    engine: Formula
    printed: Formula
    right: Formula
    singular: bool = False

    def states(self) -> list[State]:
        """The `DRAWS` states, the same at every call."""
        generator = np.random.default_rng(_SEED)
        return [self.draw(generator) for _ in range(DRAWS)]


class Errors(NamedTuple):
    """Largest |formula - engine| over all states, in units of the largest |engine|."""

    printed: float
    right: float


def examine(erratum: Erratum) -> Errors:
    """Evaluate both formulas of an erratum and the engine at all its states."""
    states = erratum.states()
    engine = jax.jit(erratum.engine)
    values = np.array([engine(state) for state in states])

    def error(formula: Formula) -> float:
        with np.errstate(divide="ignore"):
            found = np.array([formula(state) for state in states])
        if found.shape != values.shape:
            raise ValueError(
                f"{erratum.place}: a formula must return what the engine does, shape "
                f"{values.shape[1:]}, but it returned {found.shape[1:]}."
            )
        return float(np.max(np.abs(found - values)) / np.max(np.abs(values)))

    return Errors(error(erratum.printed), error(erratum.right))


def around(
    params: Mapping[str, float],
    q: Sequence[float],
    v: Numbers = 0.0,
    *,
    dq: Numbers = 0.4,
    dv: Numbers = 3.0,
    da: Numbers = 3.0,
) -> Draw:
    """States near (q, v), with parameters 0.7 to 1.4 times those given.

    Args:
        params: parameter name -> value.
        q: coordinates, shape (n,).
        v: generalized velocities.
        dq: largest deviation from q.
        dv: largest deviation from v.
        da: largest deviation of a from 0.
    """

    def draw(generator: np.random.Generator) -> State:
        def within(size: Numbers) -> np.ndarray:
            return np.asarray(size) * generator.uniform(-1.0, 1.0, len(q))

        values = {name: value * generator.uniform(0.7, 1.4) for name, value in params.items()}
        t = generator.uniform(0.0, 5.0)
        return State(t, np.asarray(q) + within(dq), np.asarray(v) + within(dv), within(da), values)

    return draw


def around_example(entry: Entry) -> Draw:
    """States near the start of the example, at any velocity."""
    return around(entry.example.params, entry.example.q0)


def rate(function: Callable, s: State, a: Any) -> jax.Array:
    """d/dt of `function(t, q, v)` along a motion that accelerates at a."""
    now = (jnp.asarray(s.t), jnp.asarray(s.q), jnp.asarray(s.v))
    return jax.jvp(function, now, (jnp.ones_like(now[0]), now[2], jnp.asarray(a)))[1]


def motion(position: Callable, s: State, a: Any) -> tuple[jax.Array, jax.Array, jax.Array]:
    """(r, r', r'') of points whose coordinates accelerate at a, each in the shape of r."""

    def velocity(t: jax.Array, q: jax.Array, v: jax.Array) -> jax.Array:
        return energy.velocity(position, t, q, v, s.params)

    r = position(s.t, s.q, s.params)
    return r, velocity(jnp.asarray(s.t), s.q, s.v), rate(velocity, s, a)
