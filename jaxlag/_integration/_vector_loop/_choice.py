"""Which solves run as a vectorized loop over trajectories."""

from typing import Any

import jax.numpy as jnp

from jaxlag._core import _xla
from jaxlag._integration._stepper import Stepper


def may_vectorize(stepper: Stepper) -> bool:
    """Whether steps have a form on numbers, as far as known before the loop is traced.

    They have none if they contain loops: over stages, or in the projection.
    """
    fast = stepper.on_scalars()
    if fast is None or not _xla.vectorizes():
        return False
    term: Any = fast.term
    in_loop = getattr(stepper.solver, "looped", False)
    return term.dtype == jnp.float64 and not (in_loop or stepper.moves) and stepper.standard
