"""Residuals by channel: measured against simulated values; loss functions."""

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlag._core._errors import invalid
from jaxlag._simulation._solution import Solution
from jaxlag._system._system import System


def channels_of(residuals: Sequence[Mapping[str, np.ndarray]]) -> tuple[str, ...]:
    """Names of all channels."""
    return tuple(dict.fromkeys(name for each in residuals for name in each))


def rms_of(residuals: Sequence[Mapping[str, np.ndarray]], channel: str) -> Float[np.ndarray, " k"]:
    """Root mean square of a channel over all samples with a number; NaN if there are none.

    Raises:
        ValueError: a channel without measurements.
    """
    known = channels_of(residuals)
    if channel not in known:
        raise invalid("channel", f"be one of {list(known)}", f"it was {channel!r}")
    values = np.concatenate([each[channel] for each in residuals if channel in each])
    count = np.count_nonzero(np.isfinite(values), axis=0)
    total = np.nansum(values**2, axis=0)
    return np.sqrt(np.where(count > 0, total / np.maximum(count, 1), np.nan))


# ---- Channels of a motion by name ----------------------------------------------------------------


Reader = Callable[[Solution], Array]


def readers(
    system: System, names: tuple[str, ...], own: Mapping[str, Reader], rows: tuple[str, ...]
) -> dict[str, Reader]:
    """name -> function of a motion that returns the channel at its save times, (s,) or (s, k).

    Args:
        system: the mechanical system.
        names: names of all measured channels.
        own: functions of the caller; they override the standard names.
        rows: names of constraint rows, whose multipliers may be measured.

    Raises:
        ValueError: an unknown name.
    """
    known = standard(system, rows) | dict(own)
    for name in names:
        if name not in known:
            fix = f"Pass channels={{{name!r}: function of a jl.Solution}} to jl.fit."
            must = f"be named as one of {sorted(known)}"
            raise invalid("channels of the experiments", must, f"one was {name!r}", fix)
    return {name: known[name] for name in names}


@lru_cache(maxsize=256)  # so that one channel is one function, compiled once
def standard(system: System, rows: tuple[str, ...]) -> dict[str, Reader]:
    """The standard channels by name."""
    found: dict[str, Reader] = {"energy": lambda motion: motion.energy}
    for name in rows:
        found[name] = lambda motion, name=name: motion.multipliers[name]
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
        widths: number of measured columns of each.
        motion: the motion.

    Raises:
        ValueError: a channel returns another number of times or columns.
    """
    count, shown = motion.ts.shape[0], []
    for (name, function), width in zip(channels.items(), widths, strict=True):
        x = jnp.asarray(function(motion))
        x = x[:, None] if x.ndim == 1 else x
        if x.shape != (count, width):
            must = f"have as many columns as were measured, {width}, at each of {count} times"
            raise invalid(f"channels[{name!r}]", must, f"its shape was {x.shape}")
        shown.append(x)
    return jnp.concatenate(shown, axis=1)


# ---- Losses: residuals r over sigma become g(r), so that a fit sums up 1/2 g^2 -------------------


def squares(r: Array) -> Array:
    """1/2 r^2."""
    return r


def soft_l1(r: Array) -> Array:
    """(1 + r^2)^(1/2) - 1: as |r| for large r."""
    return r * jnp.sqrt(2.0 / (1.0 + jnp.sqrt(1.0 + r * r)))


def huber(r: Array) -> Array:
    """1/2 r^2 up to |r| = 1.345, linear beyond."""
    k = 1.345
    large = jnp.abs(r) > k
    safe = jnp.where(large, r, k)
    return jnp.where(large, jnp.sign(r) * jnp.sqrt(2 * k * jnp.abs(safe) - k * k), r)


def cauchy(r: Array) -> Array:
    """1/2 log(1 + r^2)."""
    small = r * r < 1e-12
    x = jnp.where(small, 1.0, r * r)
    return r * jnp.where(small, 1.0, jnp.sqrt(jnp.log1p(x) / x))


LOSSES: Mapping[str, Callable[[Array], Array]] = {
    "squares": squares,
    "soft_l1": soft_l1,
    "huber": huber,
    "cauchy": cauchy,
}
