"""What the trajectories of a sweep depend on: those of a store are of one problem."""

import re
from collections.abc import Mapping
from importlib.metadata import version
from typing import Any

import jax
import numpy as np

from jaxlag._core._errors import invalid
from jaxlag._sweep._digest import arrays_in, digest_of, without_addresses
from jaxlag._sweep._plan import Plan

CONSEQUENCES = ("values", "block", "equations")
"""Parts that differ where others do; alone "equations" are those of the system."""


def problem_of(plan: Plan) -> Mapping[str, Any]:
    """By name, as JSON can hold it.

    The digest of the equations is that of the lowered program, which holds all that is computed.

    Raises:
        ValueError: the program calls Python, so that it does not hold all.
    """
    key, layout = plan.key, plan.layout
    text = plan.traced.lower().as_text()
    if re.search(r"custom_call @\w*callback", text):
        must, was = "be computed by JAX alone in a sweep with a store", "it calls back to Python"
        raise invalid("system", must, was, "Write it in jax.numpy, or leave out the store.")
    system, ts = key.system, layout.ts
    return {
        **{f"version of {name}": version(name) for name in ("jaxlag", "jax", "jaxlib")},
        "device": jax.devices()[0].device_kind,
        "n": layout.count,
        "coordinates": list(system.coordinates.labels),
        "ts": "of each case" if ts is None else f"{_shown(ts)}, {digest_of('times', ts)}",
        **plan.cases.digests,
        "keep": [*key.keep, *key.save],
        "simulate_options": {name: without_addresses(repr(x)) for name, x in sorted(key.options)},
        "values": list(layout.values),
        "block": layout.size,
        "equations": digest_of(text, arrays_in(plan.traced.jaxpr)),
    }


def _shown(ts: np.ndarray) -> str:
    return f"{len(ts)} from {ts[0]:g} to {ts[-1]:g}"


def differences(there: Mapping[str, Any], here: Mapping[str, Any]) -> str:
    """The parts of two problems that differ, as text; empty if they are equal."""
    names = [name for name in {**there, **here} if there.get(name) != here.get(name)]
    first = [name for name in names if name not in CONSEQUENCES]
    return ", ".join(
        f"{x} ({_short(there.get(x))} there, {_short(here.get(x))} here)" for x in first or names
    )


def _short(x: Any) -> str:
    return re.sub(r"\b([0-9a-f]{8})[0-9a-f]{56}\b", r"\1...", str(x))
