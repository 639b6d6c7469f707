"""Symplectic partitioned Runge-Kutta methods in canonical variables."""

from abc import abstractmethod
from functools import lru_cache
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.polynomial import legendre

from jaxlag._core._errors import invalid
from jaxlag.solvers._fixed import AbstractFixedStep
from jaxlag.solvers._implicit_step import root


class Pair(NamedTuple):
    """Coefficients of a symplectic pair: b_i ah_ij + b_j a_ji = b_i b_j.

    Attributes:
        c: nodes.
        b: weights.
        a: weights of velocities in coordinates.
        ah: weights of forces in momenta.
    """

    c: np.ndarray
    b: np.ndarray
    a: np.ndarray
    ah: np.ndarray


class AbstractPartitioned(AbstractFixedStep):
    """A symplectic pair of Runge-Kutta methods for q and p = dL/dv, any Lagrangian, implicit.

        Q_i = q0 + h sum_j a_ij V_j,
        P_i = p0 + h sum_j ah_ij (F_j + A_j^T Lam_j),    P_i = dL/dv(t_i, Q_i, V_i),
        q1 = q0 + h sum_j b_j V_j,    p1 = p0 + h sum_j b_j (F_j + A_j^T Lam_j),

    F = dL/dq + Q. It is the variational integrator of the discrete Lagrangian h sum_i b_i
    L(t_i, Q_i, V_i), and with forces Q that of the discrete Lagrange-d'Alembert principle. Without
    forces it is symplectic and keeps the momenta of all symmetries that act linearly on q. The
    state is (q, v): momenta are computed from it at the start of a step, and velocities from
    momenta at its end.

    The equations are solved for the velocities V_i until the increments stop decreasing. A step
    without convergence is reported as not solved. Velocities are NaN if d2L/dv2 is not
    positive definite. Work is integrated with the weights b.
    Second derivatives exist in every order of modes.

    The terms have the methods `sections`, `joined` (as for `Splitting`) and `canonical(args)`, an
    object with

        span(tau0, tau1) -> t1 - t0,    canonical(tau, q, v) -> (p, F),
        regular(tau, q, v) -> whether d2L/dv2 is positive definite,
        power(tau, q, v) -> rates of work,    rows -> their number,
        reaction(tau, q, lam) -> A^T lam,    position(tau, q, lam) -> phi,
        velocity(tau, q, v, lam) -> A v + b,

    of which the last two are lam itself, and the first does not use lam, for dependent rows.

    Source: Hairer, Lubich, Wanner, Geometric Numerical Integration, sec. VI.4, VI.6; Marsden,
    West, Discrete mechanics and variational integrators, Acta Numerica 10 (2001), sec. 2.6, 3.2.
    """

    stages: int = eqx.field(static=True)

    @property
    @abstractmethod
    def pair(self) -> Pair:
        """The coefficients."""

    def step(
        self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any, solver_state: Any, made_jump: Any
    ) -> tuple[Any, None, dict[str, Any], None, diffrax.RESULTS]:
        """One step from t0 to t1; there is no error estimate."""
        pair, form, (q0, v0, work) = self.pair, terms.canonical(args), terms.sections(y0)
        b, a, ah = (jnp.asarray(x, q0.dtype) for x in pair[1:])
        h = form.span(t0, t1).astype(q0.dtype)
        # A step of zero length, which is not used, would divide 0 by 0 in its derivative.
        h = jnp.where(h == 0, jnp.sqrt(jnp.finfo(h.dtype).eps), h)
        s, n, rows = self.stages, q0.shape[0], form.rows
        ts = t0 + jnp.asarray(pair.c, t0.dtype) * (t1 - t0)
        p0, _ = form.canonical(t0, q0, v0)

        def unpacked(z: Array) -> tuple[Array, Array]:
            """Velocities and impulses h Lam of the stages; of the last one 0."""
            lam = z[s * n :].reshape(s - 1, rows) if rows else jnp.zeros((s - 1, 0), z.dtype)
            return z[: s * n].reshape(s, n), jnp.concatenate([lam, jnp.zeros((1, rows), z.dtype)])

        def stage(V: Array, lam: Array) -> tuple[Array, Array, Array, Array]:
            """(Q, P, F, impulses A^T h Lam) of all stages."""
            Q = q0[None] + h * (a @ V)
            P, F = jax.vmap(form.canonical)(ts, Q, V)
            return Q, P, F, jax.vmap(form.reaction)(ts, Q, lam)

        def residual(z: Array) -> Array:
            V, lam = unpacked(z)
            Q, P, F, impulses = stage(V, lam)
            motion = P - p0[None] - ah @ (h * F + impulses)
            if not rows:
                return motion.reshape(-1)
            held = jax.vmap(form.position)(ts[1:], Q[1:], lam[:-1]) / h
            return jnp.concatenate([motion.reshape(-1), held.reshape(-1)])

        no_impulses = jnp.zeros(((s - 1) * rows,), q0.dtype)
        # Positions are rounded; over h they define velocities.
        rounded = jax.lax.stop_gradient(jnp.abs(q0 / h) + jnp.abs(v0))
        guess = jnp.concatenate([jnp.tile(v0, s), no_impulses])
        z, found = root(residual, guess, jnp.tile(rounded, s))
        V, lam = unpacked(z)
        Q, _, F, impulses = stage(V, lam)
        q1, p1 = q0 + h * (b @ V), p0 + b @ (h * F + impulses)

        def last(z: Array) -> Array:
            v, lam = z[:n], z[n:]
            motion = form.canonical(t1, q1, v)[0] - p1
            if not rows:
                return motion
            motion = motion - form.reaction(t1, q1, lam)
            return jnp.concatenate([motion, form.velocity(t1, q1, v, lam)])

        guess = jnp.concatenate([V[-1], jnp.zeros((rows,), q0.dtype)])
        rounded = jax.lax.stop_gradient(rounded + jnp.max(jnp.abs(V), axis=0))
        z, ended = root(last, guess, rounded)
        if terms.works:
            work = work + h * (b @ jax.vmap(form.power)(ts, Q, V))
        # Momenta define velocities also for an indefinite M, but no motion.
        v1 = jnp.where(form.regular(t1, q1, z[:n]), z[:n], jnp.nan)
        y1 = terms.joined(q1, v1, work)
        results: Any = diffrax.RESULTS
        lost = results.nonlinear_divergence
        result = results.where(found & ended, results.successful, lost)
        return y1, None, {"y0": y0, "y1": y1}, None, result


class GaussLegendre(AbstractPartitioned):
    """Gauss's methods: nodes are the roots of the Legendre polynomial; order twice the stages.

    The same coefficients for q and p. Symmetric, and exact for every quadratic invariant. Not for
    constraints, which would hold only at the nodes.

    Attributes:
        stages: their number, at least 1 (the implicit midpoint rule).

    Source: Hairer, Lubich, Wanner, Geometric Numerical Integration, sec. II.1.3.
    """

    stages: int = eqx.field(static=True)

    def __init__(self, stages: int = 2) -> None:
        self.stages = _at_least(1, "GaussLegendre", stages)

    @property
    def pair(self) -> Pair:
        """Gauss's coefficients."""
        return _gauss(self.stages)

    def order(self, terms: Any) -> int:
        """Order of the step."""
        return 2 * self.stages


class LobattoIIIAB(AbstractPartitioned):
    """Lobatto's methods IIIA for q and IIIB for p; order 2 s - 2 with s stages.

    Holonomic constraints hold at every stage, including the end, and their velocities at the
    end: this is part of the step, and there is no projection. With 2 stages and L = T - V this is
    Verlet's method, with constraints RATTLE.

    Attributes:
        stages: their number s, at least 2.

    Source: Jay, Symplectic partitioned Runge-Kutta methods for constrained Hamiltonian systems,
    SIAM J. Numer. Anal. 33 (1996); Hairer, Lubich, Wanner, sec. VII.1.4.
    """

    stages: int = eqx.field(static=True)

    def __init__(self, stages: int = 2) -> None:
        self.stages = _at_least(2, "LobattoIIIAB", stages)

    @property
    def pair(self) -> Pair:
        """Lobatto's coefficients."""
        return _lobatto(self.stages)

    def order(self, terms: Any) -> int:
        """Order of the step."""
        return 2 * self.stages - 2


def _at_least(least: int, name: str, stages: Any) -> int:
    whole = isinstance(stages, int | np.integer) and not isinstance(stages, bool)
    if not whole or stages < least:
        must = f"be an integer of at least {least}"
        raise invalid(f"{name}: stages", must, f"it was {stages!r}")
    return int(stages)


@lru_cache
def _gauss(stages: int) -> Pair:
    x, w = legendre.leggauss(stages)
    norms = [2.0 / (2 * k + 1) for k in range(stages)]
    a = _collocation(x, w, norms)
    return Pair(0.5 * (x + 1.0), 0.5 * w, a, a)


@lru_cache
def _lobatto(stages: int) -> Pair:
    """Nodes: the ends and the extrema of the Legendre polynomial of degree s - 1."""
    top = legendre.Legendre.basis(stages - 1)
    inner = np.sort(top.deriv().roots().real) if stages > 2 else np.zeros(0)
    for _ in range(3):
        inner = inner - top.deriv()(inner) / top.deriv(2)(inner)
    x = np.concatenate([[-1.0], 0.5 * (inner - inner[::-1]), [1.0]])
    w = 2.0 / (stages * (stages - 1) * top(x) ** 2)
    # The rule integrates the squares of all polynomials but the highest exactly.
    norms = [2.0 / (2 * k + 1) for k in range(stages - 1)] + [2.0 / (stages - 1)]
    a, b = _collocation(x, w, norms), 0.5 * w
    a[0], a[-1] = 0.0, b
    return Pair(0.5 * (x + 1.0), b, a, b * (1.0 - a.T / b[:, None]))


def _collocation(x: np.ndarray, w: np.ndarray, norms: list[float]) -> np.ndarray:
    """Integrals from the start to each node of the Lagrange polynomials, on [0, 1].

    By the discrete expansion in Legendre polynomials, which is orthogonal under the weights.
    """
    a = np.zeros((len(x), len(x)))
    for k, norm in enumerate(norms):
        polynomial = legendre.Legendre.basis(k)
        integral = polynomial.integ(lbnd=-1)
        a += np.outer(integral(x), w * polynomial(x) / norm)
    return 0.5 * a
