"""The equations of a steady motion, and the sizes of their terms."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlag._analysis._equations import Equations
from jaxlag._analysis._minimal_states import MinimalStates
from jaxlag._linalg._row_residuals import row_lengths
from jaxlag._model._constraints import ConstraintRows


class Units(NamedTuple):
    """Units in which inertias are 1.

    Attributes:
        roots: of the inertias of the independent velocities, w^T M w.
        present: the largest force |Q| + |h| in these units.
    """

    roots: Float[Array, " r"]
    present: Float[Array, ""]


class SteadyEquations(NamedTuple):
    """The equations of a steady motion as functions of z = (q, w, x, inputs).

    Attributes:
        around: the equations of motion.
        states: the independent states.
    """

    around: Equations
    states: MinimalStates

    def residuals(self, z: Float[Array, " m"]) -> Float[Array, " e"]:
        """Rates of independent velocities and of states, phi, A v + b."""
        around, n = self.around, self.around.scene.system.size
        system, params, t = around.scene.system, around.params, around.t
        rates, at = around.rates(z)[0][n:], around.point(z)
        found = [rates[np.array(self.states.velocities, int)], rates[around.speeds :]]
        terms, rows = system._program.terms(at.q, params, around.scene.sample), self._rows(z)
        if any(rows.holonomic):
            found.append(terms.position(t, at.q, params))
        if rows.size and system.quasi is None:
            found.append(terms.velocity(t, at.q, at.v, params))
        return jnp.concatenate(found)

    def _rows(self, z: Array) -> ConstraintRows:
        return self.around.scene.system._rows(self.around.params, z.dtype)

    def labels(self) -> tuple[str, ...]:
        """What the residuals are."""
        system, rows = self.around.scene.system, self._rows(self.around.z)
        rates = self.states.names[len(self.states.coordinates) :]
        found = [f"rate of {name}" for name in rates]
        names = [name for name, of_phi in zip(rows.labels, rows.holonomic, strict=True) if of_phi]
        found += [f"phi of {name!r}" for name in names]
        if system.quasi is None:
            found += [f"A v + b of {name!r}" for name in rows.labels]
        return tuple(found)

    def units(self) -> "Units":
        """At the state of `around`."""
        around = self.around
        system, at, params, t = around.scene.system, around.point(around.z), around.params, around.t
        terms = system._program.terms(at.q, params, around.scene.sample)
        M = terms.mass(t, at.q, at.v, params)
        V = jnp.eye(system.size, dtype=at.q.dtype)
        if (quasi := system.quasi) is not None:
            of = lambda w: quasi.velocities(t, at.q, quasi.full(w), params)  # noqa: E731
            V = jax.jacfwd(of)(at.w)
        m = self._rows(around.z).size
        lam = jnp.zeros((m,), at.q.dtype) if m else None
        Q = system._terms.force(t, at.q, at.v, params, at.values, lam)
        h = system._terms.bias(t, at.q, at.v, params)
        inertias = jnp.diagonal(V.T @ M @ V)[np.array(self.states.velocities, int)]
        roots = jnp.sqrt(jnp.maximum(jnp.diagonal(M), 0.0))
        present = (jnp.abs(Q) + jnp.abs(h)) / jnp.where(roots > 0, roots, jnp.inf)
        return Units(jnp.sqrt(jnp.maximum(inertias, 0.0)), jnp.max(present, initial=0.0))

    def terms(self, z: Array, F: Array, J: Array) -> Float[Array, " e"]:
        """Sizes of the terms of F, of z of this size: |J| |z|, of constraints |A| (1 + max |z|)."""
        own, (n, r) = jnp.abs(J) @ jnp.abs(z) + jnp.abs(F), self._counts
        rows, states = self._rows(z), self.around.size - n - self.around.speeds
        phi = slice(r + states, r + states + sum(rows.holonomic))
        sizes = [own[: r + states]]
        for part, x in ((phi, slice(n)), (slice(phi.stop, None), slice(n, 2 * n))):
            sizes.append(row_lengths(J[part, x]) * (1.0 + jnp.max(jnp.abs(z[x]), initial=0.0)))
        return jnp.concatenate(sizes)

    def scale(self, units: "Units", z: Array, F: Array, J: Array) -> Float[Array, " e"]:
        """The same; of rates the largest one, and that of all forces, in units of equal inertia.

        What is rounding of one rate is rounding of the others.
        """
        own, (_, r) = self.terms(z, F, J), self._counts
        roots = units.roots
        largest = jnp.maximum(jnp.max(own[:r] * roots, initial=0.0), units.present)
        rates = jnp.maximum(own[:r], largest / jnp.where(roots > 0, roots, jnp.inf))
        return jnp.concatenate([rates, own[r:]])

    @property
    def _counts(self) -> tuple[int, int]:
        """Numbers of coordinates and of independent velocities."""
        return self.around.scene.system.size, len(self.states.velocities)

    def at(self, state: tuple[Array, Array]) -> Float[Array, " e"]:
        """The residuals at (t, z)."""
        around = self.around._replace(t=state[0].astype(self.around.t.dtype))
        return self._replace(around=around).residuals(state[1])
