"""Digests of programs and of trees: equal ones have equal digests in every process."""

import re
from hashlib import sha256
from types import FunctionType
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Literal, jaxpr_as_fun

from jaxlag._core._jaxprs import constants, equations


def digest_of_program(program: ClosedJaxpr) -> str:
    """That of its text and of all arrays in it."""
    text = without_addresses(program.pretty_print(use_color=False))
    if any(_is_opaque(x) for eqn in equations(program) for x in eqn.params.values()):
        text += jax.jit(jaxpr_as_fun(program)).lower(*program.in_avals).as_text()
    return digest_of(text, arrays_in(program))


def arrays_in(program: ClosedJaxpr) -> list[Any]:
    """Constants and literals at all levels, of which texts show some entries at most."""
    literals = [x.val for eqn in equations(program) for x in eqn.invars if isinstance(x, Literal)]
    return [*constants(program), *(x for x in literals if np.ndim(x) > 0)]


def _is_opaque(x: Any) -> bool:
    """Whether the text of a jaxpr shows a name of this in place of what it does."""
    return isinstance(x, FunctionType) or type(x).__module__.startswith("jaxlag.")


def digest_of(described: str, tree: Any) -> str:
    """That of a text, and of the leaves of a tree: arrays, numbers, text, sets of them."""
    digest = sha256(described.encode())
    for x in jax.tree.leaves(tree):
        is_key = jax.dtypes.issubdtype(getattr(x, "dtype", None), jax.dtypes.prng_key)
        array = np.asarray(jax.random.key_data(x) if is_key else x)
        content = array.tobytes()
        if array.dtype == object:
            shown = sorted(map(repr, x)) if isinstance(x, set | frozenset) else repr(x)
            content = without_addresses(str(shown)).encode()
        digest.update(f"{array.shape} {array.dtype}".encode() + content)
    return digest.hexdigest()


def without_addresses(text: str) -> str:
    """A text without addresses of objects in memory, which differ between processes."""
    return re.sub("0x[0-9a-f]+", "", text)
