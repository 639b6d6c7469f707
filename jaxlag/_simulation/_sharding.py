"""Sharding: checks of arrays that are distributed over devices in an unsupported way."""

from typing import Any

import jax
from jax.core import Tracer

from jaxlag._core._errors import unsupported


def check_placement(function: str, values: Any) -> None:
    """Raise on arrays with axes of an explicit mesh, or of `shard_map` with checked axes.

    Args:
        function: its name in errors.
        values: a pytree of its arguments.

    Raises:
        ValueError: with the axes, and the code to write instead.
    """
    for leaf in jax.tree.leaves(values):
        if not isinstance(leaf, Tracer) and not _spread(leaf):
            continue
        varying, explicit = _axes(leaf)
        if varying:
            raise unsupported(
                f"`{function}` inside shard_map with check_vma=True",
                f"an argument varies over the axes {sorted(varying)}",
                "Write jax.shard_map(f, mesh=mesh, in_specs=..., out_specs=..., check_vma=False).",
            )
        if explicit:
            raise unsupported(
                f"`{function}` of arrays along explicit axes",
                f"one lies along {sorted(explicit)}",
                "Write jax.make_mesh(shape, names, axis_types=(jax.sharding.AxisType.Auto,) * n).",
            )


def _spread(x: Any) -> bool:
    """Whether it is an array with values on several devices."""
    return isinstance(x, jax.Array) and len(x.sharding.device_set) > 1


def _axes(x: Any) -> tuple[set[str], set[str]]:
    """(axes of a shard_map that it varies over, explicit axes that it is sharded over)."""
    varying: set[str] = set()
    explicit: set[str] = set()
    while isinstance(x, jax.Array):  # a variable of a jaxpr is no jax.Array
        aval = jax.typeof(x)
        manual = getattr(aval, "manual_axis_type", None)
        varying |= set(getattr(manual, "varying", getattr(aval, "vma", ())))
        spec = getattr(getattr(aval, "sharding", None), "spec", ())
        for axes in spec:
            explicit |= set() if axes is None else {axes} if isinstance(axes, str) else set(axes)
        if not isinstance(x, Tracer):
            break
        # The array inside a tracer of vmap or of a derivative.
        x = getattr(x, "val", getattr(x, "primal", None))
    return varying, explicit
