"""Params together with the traced values in the closures of a declaration."""

from typing import Any

import jax


class Programs(dict[Any, Any]):
    """Programs made on the way, which are no part of what they are made for: all are equal."""

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Programs)

    def __hash__(self) -> int:
        return hash(Programs)


@jax.tree_util.register_pytree_node_class
class ParamsWithClosure:
    """Params together with what stands for the tracers in the closures of declared functions.

    In this way these are arguments of every program, as params are, and have derivatives. Functions
    of the user's never see it: they are handed the params.

    Attributes:
        params: as the user gave them.
        values: what stands for the tracers.
        tracers: which is for which, by their identity.
        programs: those functions that read the tracers, as programs. By the time that reverse
            derivatives are written the tracers may be of the past, and nothing can be traced that
            reads them.
    """

    def __init__(
        self, params: Any, values: Any, tracers: tuple[int, ...], programs: "Programs | None" = None
    ) -> None:
        self.params, self.values, self.tracers = params, values, tracers
        self.programs = Programs() if programs is None else programs

    @property
    def by_tracer(self) -> dict[int, Any]:
        """Identity of a tracer -> what stands for it."""
        return dict(zip(self.tracers, self.values, strict=True))

    def tree_flatten(self) -> tuple[tuple[Any, Any], tuple[tuple[int, ...], "Programs"]]:
        """As JAX asks for it."""
        return (self.params, self.values), (self.tracers, self.programs)

    @classmethod
    def tree_unflatten(
        cls, fixed: tuple[tuple[int, ...], "Programs"], parts: Any
    ) -> "ParamsWithClosure":
        """As JAX asks for it."""
        (params, values), (tracers, programs) = parts, fixed
        return cls(params, values, tracers, programs)


def plain(params: Any) -> Any:
    """Params as the user gave them; anything else as it is."""
    return params.params if isinstance(params, ParamsWithClosure) else params
