"""Options of `simulate` that functions built on it pass on."""

from collections.abc import Collection, Mapping
from inspect import signature
from types import MappingProxyType
from typing import Any

import equinox as eqx
import numpy as np

from jaxlag._core._errors import invalid
from jaxlag._simulation._simulate import simulate

NO_OPTIONS: Mapping[str, Any] = MappingProxyType({})
"""No options."""


def plain_options(options: Mapping[str, Any], by: str, taken: Collection[str]) -> dict[str, Any]:
    """Options for the key of compiled programs, numbers as Python's.

    Args:
        options: by name.
        by: the function that passes them on, for errors.
        taken: names of those that it sets itself.

    Raises:
        ValueError: an option unknown to `simulate`, one of `taken`, or one with an array.
    """
    if not isinstance(options, Mapping):
        must, was = "be a dict of options of jl.simulate", f"it was {options!r}"
        raise invalid("simulate_options", must, was)
    known = signature(simulate).parameters
    found = {}
    for name, value in options.items():
        if name not in known or name == "system":
            names = [key for key in known if key not in (*taken, "system")]
            raise invalid("simulate_options", f"be among {names}", f"one was {name!r}")
        if name in taken:
            raise invalid(name, f"be left out, since {by} sets it", "it was given")
        if eqx.is_array(value) or isinstance(value, np.ndarray | np.generic):
            if np.ndim(value):
                must, was = "be one number, a name or an object without arrays", f"it was {value!r}"
                raise invalid(name, must, was)
            value = value.item()
        try:
            hash(value)
        except TypeError as error:
            must, was = "be one number, a name or an object without arrays", f"it was {value!r}"
            raise invalid(name, must, was) from error
        found[name] = value
    return found
