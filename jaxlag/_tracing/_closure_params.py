"""Params together with the traced values in the closures of a declaration."""

from typing import Any

import jax


class Programs(dict[Any, Any]):
    """A cache that does not take part in equality or hashing."""

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Programs)

    def __hash__(self) -> int:
        return hash(Programs)


@jax.tree_util.register_pytree_node_class
class ParamsWithClosure:
    """Params, with the values of the tracers in the closures of declared functions.

    The tracers are thus arguments of every program, as params are, and have derivatives. User
    functions receive only the params.

    Attributes:
        params: as the user gave them.
        values: values of the tracers.
        tracers: identities of the tracers, in the order of `values`.
        programs: traced programs of the functions that read the tracers. When reverse
            derivatives are traced, the original tracers may no longer be valid, and these functions
            cannot be traced again.
    """

    def __init__(
        self, params: Any, values: Any, tracers: tuple[int, ...], programs: "Programs | None" = None
    ) -> None:
        self.params, self.values, self.tracers = params, values, tracers
        self.programs = Programs() if programs is None else programs

    @property
    def by_tracer(self) -> dict[int, Any]:
        """Identity of a tracer -> its value."""
        return dict(zip(self.tracers, self.values, strict=True))

    def tree_flatten(self) -> tuple[tuple[Any, Any], tuple[tuple[int, ...], "Programs"]]:
        """For JAX's pytree registry."""
        return (self.params, self.values), (self.tracers, self.programs)

    @classmethod
    def tree_unflatten(
        cls, fixed: tuple[tuple[int, ...], "Programs"], parts: Any
    ) -> "ParamsWithClosure":
        """For JAX's pytree registry."""
        (params, values), (tracers, programs) = parts, fixed
        return cls(params, values, tracers, programs)


def plain(params: Any) -> Any:
    """Params as the user gave them; any other object unchanged."""
    return params.params if isinstance(params, ParamsWithClosure) else params
