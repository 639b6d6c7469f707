"""Where in the user's source an operation of a traced program was asked for."""

from typing import Any

from jax.extend import source_info_util
from jax.extend.core import ClosedJaxpr, Jaxpr


def line_of(program: Any, *primitives: str) -> str:
    """File, line and function of the first of these operations; "" where it does none of them.

    Args:
        program: traced; programs within it are searched, too.
        primitives: names of operations.
    """
    jaxpr = program.jaxpr if isinstance(program, ClosedJaxpr) else program
    for eqn in jaxpr.eqns:
        if eqn.primitive.name in primitives:
            return source_info_util.summarize(eqn.source_info)
        for value in eqn.params.values():
            for inner in value if isinstance(value, tuple) else (value,):
                if isinstance(inner, ClosedJaxpr | Jaxpr):
                    found = line_of(inner, *primitives)
                    if found:
                        return found
    return ""
