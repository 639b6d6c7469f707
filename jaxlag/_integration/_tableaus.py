"""Properties of a method from its coefficients, and the kind of its loop over stages."""

from dataclasses import replace
from typing import Any

import diffrax
import equinox as eqx
import numpy as np

from jaxlag.solvers import AbstractExplicit, AbstractFixedStep
from jaxlag.solvers._explicit import tableau_of


def remembers(solver: diffrax.AbstractSolver) -> bool:
    """Whether the solver's state is more than a function of (t, y), as in multistep methods."""
    runge_kutta = diffrax.AbstractRungeKutta | diffrax.Euler | diffrax.ImplicitEuler
    return not isinstance(solver, runge_kutta | AbstractExplicit | AbstractFixedStep)


def explicit_tableau(solver: diffrax.AbstractSolver) -> Any:
    """The coefficients of an explicit Runge-Kutta method; None for others and for wrapped ones."""
    explicit = isinstance(solver, diffrax.AbstractERK)
    return getattr(solver, "tableau", None) if explicit else None


def looks_ahead(solver: diffrax.AbstractSolver) -> bool:
    """Whether a method has stages beyond the end of its steps."""
    return bool(np.max(nodes_of(solver), initial=0.0) > 1)


def nodes_of(solver: diffrax.AbstractSolver) -> list[float]:
    """Positions of the stages of a Runge-Kutta method in a step; empty for other methods."""
    if isinstance(solver, diffrax.HalfSolver):
        return [0.5 * (half + c) for half in (0.0, 1.0) for c in (*nodes_of(solver.solver), 1.0)]
    if isinstance(solver, AbstractExplicit):
        return [float(c) for c in tableau_of(type(solver)).c]
    tableau: Any = getattr(solver, "tableau", None)
    tableaus = getattr(tableau, "tableaus", () if tableau is None else (tableau,))
    return [float(c) for x in tableaus for c in x.c]


def with_stages(solver: Any, kind: str) -> Any:
    """A Runge-Kutta solver, wrapped or not, with its loop over stages of the given kind.

    "lax" for solving, "bounded" (a scan, differentiable in every mode) for replaying.
    """
    if isinstance(solver, diffrax.HalfSolver):
        return eqx.tree_at(lambda s: s.solver, solver, with_stages(solver.solver, kind))
    if isinstance(solver, AbstractExplicit):
        return solver if kind == "lax" else replace(solver, looped=True)
    if not isinstance(solver, diffrax.AbstractRungeKutta):
        return solver
    return eqx.tree_at(lambda s: s.scan_kind, solver, kind, is_leaf=lambda x: x is None)
