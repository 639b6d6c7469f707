"""The one global setting: XLA's bound on the loops it compiles to one native function on CPU.

Before jax 0.12, XLA's CPU backend runs the body of a while loop operation by operation unless
the loop handles less than about a kilobyte; the dispatch then costs ten times the arithmetic of
a small mechanical system. XLA reads the bound once, before the first compilation.
"""

import os
import warnings
from functools import lru_cache

import jax
import jax.numpy as jnp

OPTION = "xla_cpu_small_while_loop_byte_threshold"
BYTES = 10_000_000
SWITCH = "JAXLAG_XLA_FLAGS"
EXTRA = "--xla_backend_extra_options="


def needed() -> bool:
    """Whether this jax keeps the old bound; 0.12 raised it itself."""
    return tuple(int(part) for part in jax.__version__.split(".")[:2]) < (0, 12)


def merged(flags: str) -> str:
    """XLA_FLAGS with the bound merged into the extra backend options, whatever else they hold.

    A bound that the user has set stays.
    """
    if OPTION in flags:
        return flags
    words = flags.split()
    for i, word in enumerate(words):
        if word.startswith(EXTRA):
            present = word.removeprefix(EXTRA)
            options = [present] if present else []
            words[i] = EXTRA + ",".join([*options, f"{OPTION}={BYTES}"])
            return " ".join(words)
    return " ".join([*words, f"{EXTRA}{OPTION}={BYTES}"])


def configure() -> None:
    """Set the bound, unless JAXLAG_XLA_FLAGS=0 or jax has raised it itself."""
    if needed() and os.environ.get(SWITCH) != "0":
        os.environ["XLA_FLAGS"] = merged(os.environ.get("XLA_FLAGS", ""))


@lru_cache(maxsize=1)
def in_force() -> bool:
    """Whether loops past the old bound do compile to one function: asked of XLA itself."""

    def loop(x: jax.Array) -> jax.Array:
        turn = lambda c: (c[0] + 1, c[1] * c[1][::-1])  # noqa: E731
        return jax.lax.while_loop(lambda c: c[0] < 3, turn, (0, x))[1]

    compiled = jax.jit(loop).lower(jax.ShapeDtypeStruct((1000,), jnp.float32)).compile()
    return "small_call" in (compiled.as_text() or "")


def report() -> str:
    """One line for `System.explain`."""
    if jax.default_backend() != "cpu":
        return f"the CPU setting does not apply on {jax.default_backend()}"
    if in_force():
        return "solver loops compile to one native function"
    if os.environ.get(SWITCH) == "0":
        return f"run operation by operation: {SWITCH}=0"
    return "run operation by operation: " + _LATE


_LATE = (
    "XLA had compiled something before jaxlag was imported, so its loop setting came too late. "
    "Import jaxlag before the first jax computation."
)


@lru_cache(maxsize=1)
def warn_if_late() -> None:
    """Say once per process that the setting came too late."""
    if jax.default_backend() != "cpu" or not needed() or os.environ.get(SWITCH) == "0":
        return
    if not in_force():
        warnings.warn(f"Solves will be several times slower: {_LATE}", stacklevel=4)
