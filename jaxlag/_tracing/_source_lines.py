"""The user's source line of an operation in a traced program."""

from typing import Any

from jax.extend import source_info_util

from jaxlag._core._jaxprs import equations


def line_of(program: Any, *primitives: str) -> str:
    """File, line and function of the first of these operations; "" if there is none.

    Args:
        program: traced; nested programs are searched, too.
        primitives: names of operations.
    """
    for eqn in equations(program):
        if eqn.primitive.name in primitives:
            return source_info_util.summarize(eqn.source_info)
    return ""
