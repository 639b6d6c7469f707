"""Solution: a simulated motion."""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxlag import _params
from jaxlag._errors import bad
from jaxlag._power import in_order
from jaxlag._status import ADVICE, Status
from jaxlag._system import System

# Quantities of one state, by the name `save=` and the Solution know them under.
QUANTITIES: dict[str, Callable[[System, Any, Any, Any, Any, Any], Any]] = {
    "a": lambda system, t, q, v, params, inputs: system.acceleration(params, q, v, t, inputs),
    "p": lambda system, t, q, v, params, inputs: system.momentum(params, q, v, t),
    "energy": lambda system, t, q, v, params, inputs: system.energy(params, q, v, t),
    "kinetic": lambda system, t, q, v, params, inputs: system.kinetic(params, q, v, t),
    "potential": lambda system, t, q, v, params, inputs: system.potential(params, q, v, t),
    "power": lambda system, t, q, v, params, inputs: system.power(params, q, v, t, inputs),
    "Q": lambda system, t, q, v, params, inputs: system.generalized_force(params, q, v, t, inputs),
}


def over_rows(
    name: str, system: System, ts: Array, q: Array, v: Array, params: Any, inputs: Any
) -> Any:
    """A quantity at every row of one motion; NaN where the motion did not get."""
    reached = jnp.isfinite(q[:, 0])

    def at(t: Array, q: Array, v: Array, reached: Array) -> Any:
        # Rows not reached are NaN: evaluate at the start instead, so that derivatives stay finite.
        q, v, t = (jnp.where(reached, x, x0) for x, x0 in ((q, q0), (v, v0), (t, t0)))
        value = QUANTITIES[name](system, t, q, v, params, inputs)
        return jax.tree.map(lambda x: jnp.where(reached, x, jnp.nan), value)

    t0, q0, v0 = ts[0], q[0], v[0]
    return jax.vmap(at)(ts, q, v, reached)


class Solution(eqx.Module):
    """A motion at the requested times, and how it ended.

    Shapes are those of one motion of n coordinates at s times; after `jax.vmap` every array has
    the batch axes in front. Rows not reached are NaN.

    Attributes:
        system: what was simulated.
        ts: (s,), s.
        q: coordinates (s, n), m or rad.
        v: velocities (s, n), m/s or rad/s.
        status: int32, see `Status`.
        last_time: last time reached, s.
        last_state: (q, v) there, each (n,).
        where: index of the coordinate that a failure concerns, -1 if none.
        stats: counts: "accepted" and "rejected" steps.
        saved: quantities named in `save=`, by name.
    """

    system: System
    ts: Float[Array, "*batch s"]
    q: Float[Array, "*batch s n"]
    v: Float[Array, "*batch s n"]
    status: Int[Array, "*batch"]
    last_time: Float[Array, "*batch"]
    last_state: tuple[Float[Array, "*batch n"], Float[Array, "*batch n"]]
    where: Int[Array, "*batch"]
    stats: dict[str, Int[Array, "*batch"]]
    saved: dict[str, Any]
    _params_traced: Any
    _inputs_traced: Any
    _params_static: _params.Static = eqx.field(static=True)
    _inputs_static: _params.Static = eqx.field(static=True)

    @property
    def params(self) -> Any:
        """The params of this motion, numbers as arrays."""
        return _params.join(self._params_traced, self._params_static.tree)

    @property
    def inputs(self) -> dict[str, Any]:
        """The inputs of this motion, by name."""
        return eqx.combine(self._inputs_traced, self._inputs_static.tree)

    def __getitem__(self, name: str) -> Array:
        """A coordinate by its name, shape (s, *its shape)."""
        return self.system.coordinates.part(self.q, name)

    def rate(self, name: str) -> Array:
        """The velocity of a coordinate by its name, shape (s, *its shape)."""
        return self.system.coordinates.part(self.v, name)

    @property
    def a(self) -> Float[Array, "*batch s n"]:
        """Accelerations (s, n), m/s^2 or rad/s^2, from M a + h = Q at the rows."""
        return self._quantity("a")

    @property
    def p(self) -> Float[Array, "*batch s n"]:
        """Momenta p = dL/dv, (s, n), kg m/s or kg m^2/s."""
        return self._quantity("p")

    @property
    def energy(self) -> Float[Array, "*batch s"]:
        """H = v . dL/dv - L, (s,), J."""
        return self._quantity("energy")

    @property
    def kinetic(self) -> Float[Array, "*batch s"]:
        """T, (s,), J, where the system declares it."""
        return self._quantity("kinetic")

    @property
    def potential(self) -> Float[Array, "*batch s"]:
        """V, (s,), J, where the system declares it."""
        return self._quantity("potential")

    @property
    def Q(self) -> Float[Array, "*batch s n"]:
        """Applied generalized forces, dissipation included, (s, n), N or N m."""
        return self._quantity("Q")

    @property
    def power(self) -> dict[str, Float[Array, "*batch s"]]:
        """Terms of dH/dt by name, each (s,), W, in the order of `System.power`."""
        return in_order(self._quantity("power"), self.system.forces)

    @property
    def work(self) -> dict[str, Float[Array, "*batch s"]]:
        """Work since ts[0] of every term of dH/dt by name, each (s,), J, ordered as `power`.

        The books close: H - H(ts[0]) is the sum over all names, to the accuracy of the solve.

        Raises:
            ValueError: it was not asked for with `simulate(..., save=("work",))`.
        """
        if "work" not in self.saved:
            raise bad(
                "work",
                "be asked for when simulating",
                f"save was {tuple(self.saved)!r}",
                'Write simulate(..., save=("work",)): work is integrated along with the motion.',
            )
        return in_order(self.saved["work"], self.system.forces)

    def message(self) -> str:
        """How a single motion ended, in words, with the coordinate and the likely remedy."""
        if self.ts.ndim != 1:
            raise bad("message", "be asked of a single motion", f"batch {self.ts.shape[:-1]}")
        status = Status(int(self.status))
        if status is Status.ok:
            return f"ok at t = {self.last_time}"
        index = int(self.where)
        about = f" ({self.system.coordinates.label(index)!r})" if index >= 0 else ""
        q, v = self.last_state
        return (
            f"{status.name}{about}: last good state at t = {self.last_time} of {self.ts[-1]}, "
            f"q = {q}, v = {v}, after {int(self.stats['accepted'])} accepted and "
            f"{int(self.stats['rejected'])} rejected steps. {ADVICE.get(status, '')}".rstrip()
        )

    def _quantity(self, name: str) -> Any:
        if name in self.saved:
            return self.saved[name]
        key = (self._params_static, self._inputs_static)
        traced = (self.ts, self.q, self.v, self._params_traced, self._inputs_traced)
        return _derived(name, self.system, key, self.ts.ndim - 1, traced)

    def __repr__(self) -> str:
        names = ", ".join(self.system.coordinates.names)
        return f"Solution({names}; shape {self.q.shape}, status {self.status})"


@partial(jax.jit, static_argnums=(0, 1, 2, 3))
def _derived(name: str, system: System, key: Any, batch: int, traced: Any) -> Any:
    params_static, inputs_static = key

    def one(traced: Any) -> Any:
        ts, q, v, params, inputs = traced
        params = _params.join(params, params_static.tree)
        inputs = eqx.combine(inputs, inputs_static.tree)
        return over_rows(name, system, ts, q, v, params, inputs)

    for _ in range(batch):
        one = jax.vmap(one)
    return one(traced)
