"""Second-order equations: the parts of their state and of its rates."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp


class SecondOrderForm(NamedTuple):
    """How a state y = (q, v) of dq/dtau = sigma v, dv/dtau = sigma a is stored.

    Attributes:
        parts: (q, v) of y, or of its rates.
        joined: the inverse.
        signed: sigma x, a function of (x, args).
        in_lanes: whether numbers of the state are rows of lanes.
    """

    parts: Callable
    joined: Callable
    signed: Callable
    in_lanes: bool


def second_order_form(terms: Any) -> SecondOrderForm:
    """That of the terms of `simulate`; of others y is a pair (q, v) of pytrees."""
    if not hasattr(terms, "sections"):
        return SecondOrderForm(lambda y: y, lambda q, v: (q, v), lambda x, args: x, False)

    def parts(y: Any) -> tuple[Any, Any]:
        return terms.sections(y)[:2]

    def joined(q: Any, v: Any) -> Any:
        return jnp.concatenate([q, v])

    return SecondOrderForm(parts, joined, terms.signed, terms.in_lanes)
