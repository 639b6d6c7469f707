"""What becomes of a state at the end of a step: constraints, contacts and what slides."""

from functools import reduce
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from jaxlag._dynamics import Dynamics, still
from jaxlag._forces import reads_lam, sliding
from jaxlag._linalg import closed_to
from jaxlag._lowering import Prepared, ScalarPrepared, ScalarTerms
from jaxlag._projection import Surface, project
from jaxlag._step import Arguments, Verdict


class Settling(eqx.Module):
    """Moves the end of a step onto the constraints, and looks whether what was assumed holds.

    Attributes:
        dynamics: what moves.
    """

    dynamics: Dynamics

    @property
    def _slides(self) -> tuple[Any, ...]:
        """Velocities of contact points that must not change their sign."""
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
        """The first row that friction depends on, as far as it is declared; else row 0."""
        return self._contacts[0] if self._contacts else 0

    @property
    def settles(self) -> bool:
        """Whether a step's end is moved, or looked at beyond its being finite."""
        if self.dynamics.quasi is not None:
            return self.dynamics.projects
        chosen = self.dynamics.rows.chooses  # then some may have been left out
        return self.dynamics.projects or chosen or bool(self._contacts) or bool(self._slides)

    def __call__(
        self, tau: Array, y: Array, args: Arguments, differentiable: bool = False
    ) -> tuple[Array, Verdict]:
        """The state at the end of a step as it is kept, and what is to be said about it."""
        true = jnp.array(True)
        verdict = Verdict(true, true, true)
        if self.dynamics.projects:
            y, found, closed = self.project(tau, y, args, differentiable)
            verdict = Verdict(found, closed, true)
        elif args.rows is not None:

            def look() -> Array:
                surface = self.dynamics.surface(*still((tau, y, args)))
                return self._closed(surface, *self.dynamics.parts(still(y)), args)

            one = self.dynamics.rows.size == 1
            hold = jax.lax.cond(args.rows.kept[0], lambda: true, look) if one else look()
            verdict = Verdict(true, hold, true)
        return y, verdict._replace(pressed=self.pressed(tau, y, args))

    def pressed(self, tau: Array, y: Array, args: Arguments) -> Bool[Array, ""]:
        """Whether contacts press and slide as their friction takes them to."""
        if not self._contacts and not self._slides:
            return jnp.array(True)
        tau, y, args = still((tau, y, args))
        t, q, v, params, values = self.dynamics.at(tau, y, args)
        right, terms = [], self.dynamics.terms
        if self._contacts:
            if isinstance(args.prepared, ScalarPrepared) and isinstance(terms, ScalarTerms):
                lam = terms.multipliers(t, q, v, params, values, args.prepared)
            else:
                array, prepared = self.dynamics.array, args.prepared
                assert isinstance(prepared, Prepared)
                lam = array.multipliers(t, q, v, params, values, prepared, args.reacting)
            right += [lam[row] >= 0 for row in self._contacts]
        for k, slide in enumerate(self._slides):
            assert args.senses is not None
            right.append(slide(t, q, v, params) * args.senses[k] > 0)
        return jnp.all(jnp.stack(right))

    def project(
        self, tau: Array, y: Array, args: Arguments, differentiable: bool = False
    ) -> tuple[Any, Bool[Array, ""], Bool[Array, ""]]:
        """(state on the constraints nearest to y, whether found, whether all rows hold there)."""
        frozen = None
        if differentiable:
            frozen = self.dynamics.surface(*still((tau, y, args)))
        surface, (q, v) = self.dynamics.surface(tau, y, args), self.dynamics.parts(y)
        q, v, found = project(surface, q, v, frozen)
        rest = self.dynamics.system.size + self.dynamics.speeds
        return jnp.concatenate([q, v, y[rest:]]), found, self._closed(surface, q, v, args)

    def _closed(self, surface: Surface, q: Array, v: Array, args: Arguments) -> Bool[Array, ""]:
        """Whether rows that were left out hold as well.

        Where nothing holds the others, these may drift as they do.
        """
        if args.rows is None:
            return jnp.array(True)
        kept, size = args.rows.kept, args.rows.size
        holonomic = np.flatnonzero(self.dynamics.rows.holonomic).tolist()
        floor = closed_to(q.dtype)

        def holds(c: Array, x: Array, rows: list[int]) -> Array:
            largest = jnp.max(jnp.abs(x))
            off = [jnp.abs(c[i]) / size[row] for i, row in enumerate(rows)]
            drift = [jnp.where(kept[row], x, 0.0) for row, x in zip(rows, off, strict=True)]
            allowed = floor * (1.0 + largest) + 100.0 * reduce(jnp.maximum, drift)
            found = [kept[row] | (x <= allowed) for row, x in zip(rows, off, strict=True)]
            return jnp.all(jnp.stack(found))

        closed = jnp.array(True)
        if surface.velocity is not None:
            closed = holds(surface.velocity(q, v), v, list(range(self.dynamics.rows.size)))
        if surface.position is not None:
            closed = closed & holds(surface.position(q), q, holonomic)
        return closed
