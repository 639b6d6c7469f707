"""Post-step processing: project onto the constraints; check contacts and the sliding direction."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from jaxlag._core._arrays import stop_gradient
from jaxlag._integration._change_points import LOST, SHORT, lengths_of, unknown_below
from jaxlag._integration._step_arguments import Arguments, StepChecks
from jaxlag._integration._vector_field import VectorField
from jaxlag._linalg._mass_solve import closed_to
from jaxlag._linalg._projection import ConstraintProjector, project, tangential
from jaxlag._lowering import State
from jaxlag._model._forces import reads_lam, sliding


class StepEnd(eqx.Module):
    """Projects the end of a step onto the constraints, and checks the assumptions of the step.

    Attributes:
        dynamics: the vector field.
    """

    dynamics: VectorField

    @property
    def _slides(self) -> tuple[Any, ...]:
        """Velocities of contact points whose sign must not change."""
        return sliding(self.dynamics.system.forces)

    @property
    def _contacts(self) -> list[int]:
        """Rows whose multipliers must not become negative."""
        names = {f.contact for f in filter(reads_lam, self.dynamics.system.forces)}
        rows, start = [], 0
        for name, shape in self.dynamics.rows.shapes:
            stop = start + int(np.prod(shape))
            rows += range(start, stop) if name in names else ()
            start = stop
        return rows

    @property
    def contact_row(self) -> int:
        """The first row whose multiplier friction reads; else row 0."""
        return self._contacts[0] if self._contacts else 0

    @property
    def settles(self) -> bool:
        """Whether the end of a step is projected, or checked for more than finite values."""
        if self.dynamics.quasi is not None:
            return self.dynamics.projects
        chosen = self.dynamics.rows.chooses  # then some may have been left out
        return self.dynamics.projects or chosen or bool(self._contacts) or bool(self._slides)

    def __call__(
        self, tau: Array, y: Array, args: Arguments, differentiable: bool = False
    ) -> tuple[Array, StepChecks]:
        """The accepted state at the end of a step, and its checks."""
        true = jnp.array(True)
        checks = StepChecks(true, true, true)
        if self.dynamics.projects:
            y, checks = self.project(tau, y, args, differentiable)
        elif args.rows is not None:

            def look() -> Array:
                surface = self.dynamics.projector(*stop_gradient((tau, y, args)))
                return self._closed(surface, *self.dynamics.parts(stop_gradient(y)), args)

            one = self.dynamics.rows.size == 1
            hold = jax.lax.cond(args.rows.active_rows[0], lambda: true, look) if one else look()
            checks = StepChecks(true, hold, true)
        return y, checks._replace(contacts_valid=self.contacts_valid(tau, y, args))

    def contacts_valid(self, tau: Array, y: Array, args: Arguments) -> Bool[Array, ""]:
        """Whether contacts press, and slide in the direction that their friction assumes."""
        if not self._contacts and not self._slides:
            return jnp.array(True)
        tau, y, args = stop_gradient((tau, y, args))
        t, q, v, params, values = self.dynamics.at(tau, y, args)
        right = []
        if self._contacts:
            state = State(t, q, v, params, values)
            lam = self.dynamics.program.multipliers(state, args.constants, args.multiplier_rows)
            right += [lam[row] >= 0 for row in self._contacts]
        for k, slide in enumerate(self._slides):
            assert args.senses is not None
            right.append(slide(t, q, v, params) * args.senses[k] > 0)
        return jnp.all(jnp.stack(right))

    def project(
        self, tau: Array, y: Array, args: Arguments, differentiable: bool = False
    ) -> tuple[Array, StepChecks]:
        """The nearest state on the constraints, and its checks."""
        return self._projected(self._near(tau, y, args, differentiable), y, args)

    def with_error(
        self, tau: Array, y: Array, args: Arguments, error: Array, near: Bool[Array, ""]
    ) -> tuple[Array, StepChecks, Array, ConstraintProjector]:
        """The same as a call, with the error of the accepted state and the constraints near it.

        It differs from `error` only near change points. Elsewhere errors across the rows, which the
        projection removes, are as small as those along them.

        Args:
            tau: time.
            y: state at the end of a step.
            args: arguments of the step.
            error: estimate for y.
            near: whether the step starts near a change point.
        """
        around = self._near(tau, y, args)
        y, checks = self._projected(around, y, args)
        assert checks.independence is not None

        def left() -> Array:
            parts = self.dynamics.parts
            return self._joined(*tangential(around.surface, *parts(y), *parts(error)), error)

        error = jax.lax.cond(near | (checks.independence < SHORT), left, lambda: error)
        checks = checks._replace(contacts_valid=self.contacts_valid(tau, y, args))
        return y, checks, error, around.surface

    def stage(self, tau: Array, y: Array, args: Arguments, refuses: bool) -> Array:
        """A state within a step after one Newton iteration towards the constraints.

        Its matrix is not differentiated: a motion on the constraints does not depend on it, nor do
        derivatives of that motion.

        Args:
            tau: time of the stage.
            y: its state.
            args: arguments of the step.
            refuses: whether the result is NaN at a change point, so that the step is rejected; for
                steps without an error estimate.
        """
        around = self._near(*stop_gradient((tau, y, args)))
        near, independence = around.surface, around.independence
        assert independence is not None
        surface = self.dynamics.projector(tau, y, args)
        (q, v), velocity, kick = self.dynamics.parts(y), surface.velocity, near.kick
        if surface.position is not None:
            q = q - near.shift(surface.position(q))
        assert velocity is not None
        assert kick is not None
        moved = self._joined(q, v - kick(velocity(q, v)), y)
        if not refuses:
            return moved
        return jnp.where(independence > unknown_below(independence.dtype), moved, jnp.nan)

    def independence(self, tau: Array, y: Array, args: Arguments) -> Array:
        """The least row length over its length at the start of the motion."""
        found = self._near(*stop_gradient((tau, y, args))).independence
        assert found is not None
        return found

    def _projected(self, near: "_Near", y: Array, args: Arguments) -> tuple[Array, StepChecks]:
        q, v, converged = project(near.surface, *self.dynamics.parts(y), near.frozen)
        closed = self._closed(near.surface, q, v, args)
        return self._joined(q, v, y), StepChecks(
            converged, closed, jnp.array(True), near.independence
        )

    def _near(self, tau: Array, y: Array, args: Arguments, differentiable: bool = False) -> "_Near":
        """The constraints near a state, without almost dependent rows."""
        surface, frozen = self.dynamics.projector(tau, y, args), None
        if differentiable:
            frozen = self.dynamics.projector(*stop_gradient((tau, y, args)))
        if args.lengths is None:
            return _Near(surface, frozen, None)
        masses = (surface if frozen is None else frozen).masses
        assert masses is not None
        lengths = lengths_of(masses, args.active_rows)
        alone = lengths > LOST * args.lengths
        holonomic = np.flatnonzero(self.dynamics.rows.holonomic)

        def without(surface: ConstraintProjector) -> ConstraintProjector:
            shift, kick = surface.shift, surface.kick
            assert kick is not None
            return surface._replace(
                shift=lambda c: shift(jnp.where(alone[holonomic], c, 0.0)),
                kick=lambda c: kick(jnp.where(alone, c, 0.0)),
            )

        frozen = None if frozen is None else without(frozen)
        return _Near(without(surface), frozen, jnp.min(lengths / args.lengths))

    def _joined(self, q: Array, v: Array, y: Array) -> Array:
        """The state y with new coordinates and velocities."""
        return jnp.concatenate([q, v, y[self.dynamics.system.size + self.dynamics.speeds :]])

    def _closed(
        self, surface: ConstraintProjector, q: Array, v: Array, args: Arguments
    ) -> Bool[Array, ""]:
        """Whether rows that were left out as dependent are satisfied.

        Without stabilization the active rows drift, and these may drift in proportion.
        """
        if args.rows is None:
            return jnp.array(True)
        active, size = args.rows.active_rows, args.rows.size
        floor = closed_to(q.dtype)

        def holds(c: Array, x: Array, active: Array, size: Array) -> Array:
            off = jnp.abs(c) / size
            drift = jnp.max(jnp.where(active, off, 0.0))
            allowed = floor * (1.0 + jnp.max(jnp.abs(x))) + 100.0 * drift
            return jnp.all(active | (off <= allowed))

        closed = jnp.array(True)
        if surface.velocity is not None:
            closed = holds(surface.velocity(q, v), v, active, size)
        if surface.position is not None:
            if not all(self.dynamics.rows.holonomic):
                holonomic = np.flatnonzero(self.dynamics.rows.holonomic)
                active, size = active[holonomic], size[holonomic]
            closed = closed & holds(surface.position(q), q, active, size)
        return closed


class _Near(NamedTuple):
    """The constraints near a state, and their distance from dependence.

    Attributes:
        surface: the constraints.
        frozen: the same without derivatives; None if it is not needed.
        independence: see `_change_points.Crossing`; None if it is not needed.
    """

    surface: ConstraintProjector
    frozen: ConstraintProjector | None
    independence: Array | None
