"""Params, and beside them the traced values that a declaration closes over."""

from typing import Any

import jax


@jax.tree_util.register_pytree_node_class
class Closed:
    """Params together with what stands for the tracers in the closures of declared functions.

    In this way these are arguments of every program, as params are, and have derivatives. Functions
    of the user's never see it: they are handed the params.

    Attributes:
        params: as the user gave them.
        values: what stands for the tracers.
        tracers: which is for which, by their identity.
    """

    def __init__(self, params: Any, values: Any, tracers: tuple[int, ...]) -> None:
        self.params, self.values, self.tracers = params, values, tracers

    @property
    def by_tracer(self) -> dict[int, Any]:
        """Identity of a tracer -> what stands for it."""
        return dict(zip(self.tracers, self.values, strict=True))

    def tree_flatten(self) -> tuple[tuple[Any, Any], tuple[int, ...]]:
        """As JAX asks for it."""
        return (self.params, self.values), self.tracers

    @classmethod
    def tree_unflatten(cls, tracers: tuple[int, ...], parts: Any) -> "Closed":
        """As JAX asks for it."""
        params, values = parts
        return cls(params, values, tracers)


def plain(params: Any) -> Any:
    """Params as the user gave them; anything else as it is."""
    return params.params if isinstance(params, Closed) else params
