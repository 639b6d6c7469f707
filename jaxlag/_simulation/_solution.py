"""Solution: a simulated motion."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxlag._core._arrays import concrete, stop_gradient
from jaxlag._core._by_name import ByName, no_attribute
from jaxlag._core._errors import SimulationError, invalid, unsupported
from jaxlag._core._status import Status
from jaxlag._model._constraints import Baumgarte
from jaxlag._model._states import state_names
from jaxlag._simulation._abstract_solution import AbstractSolution
from jaxlag._simulation._ending_message import ended
from jaxlag._simulation._failure import Ending, MotionKey, diagnose_failure, is_open
from jaxlag._simulation._methods import METHODS
from jaxlag._simulation._quantities import at_saves
from jaxlag._simulation._resolve_between import states_at
from jaxlag._simulation._solution_views import (
    ELSEWHERE,
    as_dataset,
    as_dict,
    counted,
    described,
    plotted,
)
from jaxlag._simulation._step_diagnosis import explain
from jaxlag._system._power import in_order
from jaxlag._system._system import System
from jaxlag._tracing import _params
from jaxlag._tracing._closure_params import plain
from jaxlag._tracing._compiled import Compiled


class Solution(AbstractSolution):
    """A motion at the requested times, and its status.

    Shapes are those of one motion of n coordinates at s times; after `jax.vmap` every array has
    the batch axes in front. States not reached are NaN, and so are their derivatives: exclude
    failed motions from a loss over a batch by `jnp.where(motion.ok, loss, 0.0)`.

    Attributes:
        system: the simulated system.
        ts: (s,), s.
        q: coordinates (s, n), m or rad.
        v: velocities (s, n), m/s or rad/s.
        x: states beside them, (s, k), if the system has some (`jl.States`); else None.
        last_time: last time reached, s.
        last_state: (q, v) there, each (n,).
        last_x: x there, (k,); None without states.
        stats: counts of "accepted" and "rejected" steps.
        gradient_mode: a `GradientMode`: how reverse derivatives of this motion are computed.
        saved: quantities named in `save=`, by name.
        formulation: "quasi" if the state was (q, u), else how accelerations were solved for.
        stabilization: "projection", a `Baumgarte`, or None: how states were kept on the constraints
            between steps.
        tolerances: (rtol, atol) of the step-size control; None with fixed steps.
        dt_max: bound on adaptive steps, s; None if none was given.
        change_points: "pass" or "stop", see `simulate`.
        error: with `estimate_error=True` the estimated errors of (q, v) at each save time, each
            (s, n), in their units, and those of x, (s, k), if there are states; else None.
    """

    system: System
    ts: Float[Array, "*batch s"]
    q: Float[Array, "*batch s n"]
    v: Float[Array, "*batch s n"]
    x: Float[Array, "*batch s k"] | None
    last_time: Float[Array, "*batch"]
    last_state: tuple[Float[Array, "*batch n"], Float[Array, "*batch n"]]
    last_x: Float[Array, "*batch k"] | None
    stats: dict[str, Int[Array, "*batch"]]
    gradient_mode: Int[Array, "*batch"]
    saved: dict[str, Any]
    _params_traced: Any
    _inputs_traced: Any
    _params_static: _params.Static = eqx.field(static=True)
    _inputs_static: _params.Static = eqx.field(static=True)
    formulation: str = eqx.field(static=True)
    _method: Int[Array, "*batch"]  # in METHODS; -1 for another
    _solver: str = eqx.field(static=True)  # its name, then
    stabilization: str | Baumgarte | None = eqx.field(static=True)
    _ending: Ending
    _kinematic: bool = eqx.field(static=True)
    _implicit: bool = eqx.field(static=True)
    _solve: Callable = eqx.field(static=True)  # `simulate`, which made it
    tolerances: tuple[Float[Array, "*batch"], Float[Array, "*batch_and_coordinates"]] | None
    dt_max: Float[Array, "*batch"] | None = None
    change_points: str = eqx.field(static=True, default="pass")
    error: tuple[Float[Array, "*batch s _"], ...] | None = None
    # (last good time, index of the quasi-velocity) if "auto" continued with multipliers
    _singular: tuple[Float[Array, ""], Int[Array, ""]] | None = None

    @property
    def status(self) -> Int[Array, "*batch"]:
        """How the motion ended: int32, see `Status`.

        For a failed motion this examines the states around its end.
        """
        return self._explained().status

    @property
    def ok(self) -> Bool[Array, "*batch"]:
        """Whether the motion reached ts[-1]. Unlike `status` it costs nothing inside jit."""
        return self.raw_status == int(Status.ok)

    @property
    def raw_status(self) -> Int[Array, "*batch"]:
        """The status of the loop, before the states around the end are examined."""
        return self._ending.status

    @property
    def where(self) -> Int[Array, "*batch"]:
        """Index of the coordinate or constraint row that a failure concerns; -1 if none.

        n + i for state i beside n coordinates.
        """
        return self._explained().where

    @property
    def scene(self) -> MotionKey:
        """The key of compiled programs for this motion."""
        keys = self._params_static, self._inputs_static, self.formulation, self.stabilization
        return MotionKey(self.system, *keys, self._kinematic, self._implicit)

    def _explained(self) -> Ending:
        if not is_open(self._ending):
            return self._ending
        start = self.q[..., 0, :], self.v[..., 0, :], None if self.x is None else self.x[..., 0, :]
        last = (*self.last_state, *([] if self.last_x is None else [self.last_x]))
        end = self.last_time, jnp.concatenate(last, axis=-1)
        at = self._ending, *end, self.ts, *start
        batch = self.ts.ndim - 1
        return diagnose_failure(self.scene, batch, (*at, self._params_traced, self._inputs_traced))

    @property
    def method(self) -> str:
        """Name of the method used; the name of its class if it is not a named method."""
        if self._solver:
            return self._solver
        if not concrete(self._method):
            raise unsupported("`method` inside jit or vmap", "the motion has no values there")
        return list(METHODS)[int(np.ravel(self._method)[0])]

    @property
    def params(self) -> Any:
        """The params of this motion, numbers as arrays."""
        return plain(self._given)

    @property
    def _given(self) -> Any:
        return _params.join(self._params_traced, self._params_static.tree)

    @property
    def inputs(self) -> dict[str, Any]:
        """The inputs of this motion, by name: tables, functions, constants as arrays."""
        return eqx.combine(self._inputs_traced, self._inputs_static.tree)

    @property
    def input_values(self) -> dict[str, Any]:
        """Values of the inputs at the save times, by name, each (s, *its shape).

        They are those at these times, `Feedback` included; at a knot of a table the later ones.
        """
        return ByName(self._quantity("input_values"))

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Shape of the leading axes, () for a single motion."""
        return self.ts.shape[:-1]

    def __getitem__(self, name: Any) -> Any:
        """A coordinate or state by its name, (s, *its shape), or a quasi-velocity, (s,).

        "x'" is the velocity of "x", as in `to_dict`.

        For a batch, an index, a slice or an array of indices selects motions. A batch is a
        sequence of its motions: `len(motions)`, `for motion in motions`.

        Raises:
            ValueError: no such name; an index into a single motion.
            IndexError: an index beyond the axes of the batch.
        """
        quasi, names = self.system.quasi, self.system.coordinates.names
        known = names if quasi is None else (*names, *quasi.names)
        known = *known, *state_names(self.system.states)
        if isinstance(name, str) and name[:-1] in names and name not in known and name[-1] == "'":
            return self.rate(name[:-1])
        if not isinstance(name, str):
            if self.ts.ndim == 1:
                must, was = "be a name, for a single motion", f"it was {name!r}"
                raise invalid(
                    "name", must, was, "For a save time index motion.ts, motion.q, motion.v."
                )
            return self._select(name)
        states, x = self.system.states, self.x
        if states is not None and x is not None and name in states.names:
            return states.layout.part(x, name)
        if quasi is not None and name in quasi.names:
            return self.u[..., quasi.names.index(name)]
        if name not in known:
            raise invalid("name", f"be one of {list(known)}", f"it was {name!r}")
        return self.system.coordinates.part(self.q, name)

    def __getattr__(self, name: str) -> Any:
        return no_attribute(self, name, ELSEWHERE)

    def rate(self, name: str) -> Array:
        """The velocity of a coordinate, or the rate of a state, by its name, (s, *its shape)."""
        coordinates, states = self.system.coordinates, self.system.states
        if states is not None and name in states.names:
            return states.layout.part(self.state_rates, name)
        if states is not None and name not in coordinates.names:
            known = [*coordinates.names, *states.names]
            raise invalid("name", f"be one of {known}", f"it was {name!r}")
        return coordinates.part(self.v, name)

    @property
    def state_rates(self) -> Float[Array, "*batch s k"]:
        """dx/dt of the states beside (q, v), (s, k), in their units per s.

        Raises:
            ValueError: the system has none.
        """
        return self._quantity("state_rates")

    @property
    def a(self) -> Float[Array, "*batch s n"]:
        """Accelerations (s, n), m/s^2 or rad/s^2, from M a + h = Q + A^T lam at the save times."""
        return self._quantity("a")

    @property
    def u(self) -> Float[Array, "*batch s k"]:
        """Quasi-velocities (s, k), m/s or rad/s, in the order of their names.

        Raises:
            ValueError: the system has none.
        """
        return self._quantity("u")

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
        """T, (s,), J, if the system declares it."""
        return self._quantity("kinetic")

    @property
    def potential(self) -> Float[Array, "*batch s"]:
        """V, (s,), J, if the system declares it."""
        return self._quantity("potential")

    @property
    def Q(self) -> Float[Array, "*batch s n"]:
        """Applied generalized forces, dissipation included, (s, n), N or N m."""
        return self._quantity("Q")

    @property
    def multipliers(self) -> dict[str, Float[Array, "..."]]:
        """Multipliers by the name of the row, each (s,) or (s, its shape).

        See `System.multipliers` for sign, unit and dependent rows.
        """
        found = self._quantity("multipliers")
        names = [name for c in self.system.constraints for name in c.all_names]
        return ByName({name: found[name] for name in names})

    @property
    def lam(self) -> dict[str, Float[Array, "..."]]:
        """Short for `multipliers`."""
        return self.multipliers

    @property
    def constraint_force(self) -> Float[Array, "*batch s n"]:
        """A^T lam, (s, n), N or N m: the generalized force of the constraints."""
        return self._quantity("constraint_force")

    @property
    def power(self) -> dict[str, Float[Array, "*batch s"]]:
        """Terms of dH/dt by name, each (s,), W, in the order of `System.power`."""
        terms = self._quantity("power")
        return ByName(in_order(terms, self.system.forces, self.system.constraints))

    @property
    def work(self) -> dict[str, Float[Array, "*batch s"]]:
        """Work since ts[0] of every term of dH/dt by name, each (s,), J, ordered as `power`.

        Energy balance: H - H(ts[0]) is the sum over all names, to the accuracy of the solve.

        Raises:
            ValueError: `simulate` was called without `save=("work",)`.
        """
        if "work" not in self.saved:
            raise unsupported(
                f"`work` of a motion with save={tuple(self.saved)!r}",
                "it is integrated along with the motion",
                'Write simulate(..., save=("work",)).',
            )
        terms = self.saved["work"]
        return ByName(in_order(terms, self.system.forces, self.system.constraints))

    def check(self) -> "Solution":
        """The motion itself if it is ok; raises if it, or one of a batch, is not.

        Under `jit` and `vmap` nothing can be raised: use `ok`. States not reached are NaN.

        Raises:
            SimulationError: a status other than ok, of a motion with concrete values; its `motion`
                attribute is the part that was reached.
        """
        if concrete(self.raw_status) and np.any(np.asarray(self.raw_status) != int(Status.ok)):
            # Under grad the numbers are traced, but have values.
            motion = stop_gradient(self)
            ended = "Simulation" if self.ts.ndim == 1 else "Simulations"
            raise SimulationError(f"{ended} ended with status {motion.message()}", motion)
        return self

    def message(self) -> str:
        """How a motion ended, as text, with the coordinate and the likely remedy.

        For a batch: the number of motions in each status, and the message of the first of each.
        """
        if self.ts.ndim != 1:
            return counted(self)
        return ended(self, self._explained().lost)

    @property
    def fallback(self) -> str:
        """Why formulation "auto" took multipliers instead of quasi-velocities; "" if it did not."""
        if self._singular is None or self.system.quasi is None:
            return ""
        time, index = self._singular
        name = self.system.quasi.names[int(index)]
        return f"by multipliers, as dU/dv is singular at t = {float(time):.6g} ({name!r})"

    def explain(self) -> str:
        """Why the solve took this number of steps, and what to change; for a single motion.

        It examines up to 8 of the save times: the fastest rates of the linearized equations there
        (stiffness), rejected steps and cond(M). It also takes an explicit step of order 8 from
        there, of the mean length of the motion's steps: the component with the largest error, and
        the number of iterations of the projection.

        Returns:
            A few lines of text, the last of them advice.

        Raises:
            ValueError: for a batch, or inside jit or vmap.
        """
        return explain(self)

    def at(self, t: Any) -> "Solution":
        """The motion between its save times, as accurate as there.

        The equations are solved again from the last save time before, by the same method and
        tolerances.

        Args:
            t: a number or several in any order, (k,), from ts[0] to last_time, s.

        Returns:
            A Solution at these times, with the same saved quantities; work from ts[0] on.

        Raises:
            ValueError: times outside of the motion; a batch, fixed steps or a method without a
                name: in these cases pass the times to `simulate`.
        """
        return states_at(self, t, self._solve)

    def _at_saves(self, indices: list[int]) -> "Solution":
        """The same at these save times only, in this order."""
        index = np.array(indices)
        parts = lambda s: (s.ts, s.q, s.v, s.x, s.saved, s.error)  # noqa: E731
        chosen = jax.tree.map(lambda x: x[index], parts(self))
        return eqx.tree_at(parts, self, chosen, is_leaf=lambda x: x is None)

    def to_dict(self) -> dict[str, np.ndarray]:
        """Numpy arrays by name: "t", s; every coordinate "x" and its velocity "x'", (s, *shape).

        Quasi-velocities and the quantities in `save=` are included. For a batch every array has
        its axes in front.
        """
        return as_dict(self)

    def to_xarray(self) -> Any:
        """The arrays of `to_dict` as an `xarray.Dataset` over "t"; needs the extra "xarray".

        For a batch also over "motion" (or "motion_0", ...). If its motions have different times,
        "save" replaces "t". "status" is a variable.

        Raises:
            ValueError: xarray is not installed.
        """
        return as_dataset(self)

    def plot(self) -> Any:
        """Coordinates and energy over time, and paths in the plane; needs the extra "plot".

        Paths are drawn for coordinates called x and y, or x1 and y1, and for points of two
        components. For a batch up to 16 motions are drawn.

        Returns:
            A matplotlib `Figure`, which notebooks show; `figure.savefig("motion.png")` saves it.

        Raises:
            ValueError: matplotlib is not installed.
        """
        return plotted(self)

    def _quantity(self, name: str) -> Any:
        if name in self.saved:
            return self.saved[name]
        key = (name, self.system, self.formulation), self._params_static, self._inputs_static
        states = self.q, self.v, self.x
        traced = self._params_traced, self._inputs_traced, self.ts, states
        return _derived.program(*key, self.ts.ndim - 1, traced)

    def __repr__(self) -> str:
        return described(self)


_derived = Compiled(at_saves)
