"""Channels: what a motion shows of a name that was measured."""

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxlag._core._errors import bad
from jaxlag._simulation._solution import Solution
from jaxlag._system._system import System

Reader = Callable[[Solution], Array]


def readers(
    system: System, names: tuple[str, ...], own: Mapping[str, Reader], rows: tuple[str, ...]
) -> dict[str, Reader]:
    """name -> function of a motion that gives the channel at its rows, (s,) or (s, k).

    Args:
        system: what moves.
        names: of all channels that were measured.
        own: functions of the caller, which go before what names mean otherwise.
        rows: names of constraint rows, whose multipliers may be measured.

    Raises:
        ValueError: a name that means nothing.
    """
    known = standard(system, rows) | dict(own)
    for name in names:
        if name not in known:
            fix = f"Pass channels={{{name!r}: function of a jl.Solution}} to jl.fit."
            must = f"be named as one of {sorted(known)}"
            raise bad("channels of the experiments", must, f"one was {name!r}", fix)
    return {name: known[name] for name in names}


@lru_cache(maxsize=256)  # so that one channel is one function, and what is compiled stays so
def standard(system: System, rows: tuple[str, ...]) -> dict[str, Reader]:
    """What names mean by themselves."""
    found: dict[str, Reader] = {"energy": lambda motion: motion.energy}
    for name in rows:
        found[name] = lambda motion, name=name: motion.lam[name]
    if system.quasi is not None:
        for name in system.quasi.names:
            found[name] = lambda motion, name=name: motion[name]
    part = system.coordinates.part
    for name in system.coordinates.names:
        found[name] = lambda motion, name=name: motion[name]
        found[f"{name}'"] = lambda motion, name=name: motion.rate(name)
        found[f"{name}''"] = lambda motion, name=name: part(motion.a, name)
    return found


def read(
    channels: Mapping[str, Reader], widths: Sequence[int], motion: Solution
) -> Float[Array, "s m"]:
    """All channels of a motion, side by side.

    Args:
        channels: name -> function of a motion.
        widths: columns that were measured of each.
        motion: what is seen.

    Raises:
        ValueError: a channel shows another number of rows or columns.
    """
    count, shown = motion.ts.shape[0], []
    for (name, function), width in zip(channels.items(), widths, strict=True):
        x = jnp.asarray(function(motion))
        x = x[:, None] if x.ndim == 1 else x
        if x.shape != (count, width):
            must = f"have as many columns as were measured, {width}, at each of {count} times"
            raise bad(f"channels[{name!r}]", must, f"the motion shows {x.shape}")
        shown.append(x)
    return jnp.concatenate(shown, axis=1)
