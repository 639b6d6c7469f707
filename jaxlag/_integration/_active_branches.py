"""Branch outcomes of the comparisons in a declaration; forces are smooth while they stay equal."""

from typing import Any

import jax
from jaxtyping import Array

from jaxlag._integration._step_arguments import Arguments
from jaxlag._integration._vector_field import VectorField
from jaxlag._model._input_signals import AbstractInput, AbstractTable
from jaxlag._model._inputs import evaluate
from jaxlag._system._closure_tracers import declared
from jaxlag._tracing import _params
from jaxlag._tracing._input_values import InputValues
from jaxlag._tracing._nonsmooth_points import outcomes


def branches(dynamics: VectorField, tau: Array, y: Array, args: Arguments) -> Array | None:
    """Outcomes of the comparisons in the declaration at (tau, y); None if there are none.

    Forces are smooth as long as the outcomes stay the same. Tables and functions with knots have
    their kinks and jumps at ends of steps. Multipliers that forces read are set to 0.
    """
    t, q, v, params, values = dynamics.at(tau, y, args)
    _, inputs = dynamics.given(args)
    inside = {
        name: x
        for name, x in inputs.items()
        if isinstance(x, AbstractInput) and not isinstance(x, AbstractTable) and x.knots() is None
    }
    traced, static = _params.halves((params, inside))

    def everything(t: Array, q: Array, v: Array, values: Any, traced: Any) -> Any:
        params, inside = _params.join(traced, static)
        found = evaluate(inside, t, q, v, params)
        return declared(dynamics.system, t, q, v, params, InputValues(values | dict(found)), None)

    moving, rest = (t, q, v, dict(values)), jax.tree.leaves(traced)
    program = jax.make_jaxpr(everything)(*moving, traced)
    first = jax.tree.leaves(moving)
    which = [True] * len(first) + [False] * len(rest)
    return outcomes(program, [*first, *rest], which)
