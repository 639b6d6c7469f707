"""Verification of a scalar program against the array program, at random states, uncompiled."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from numpy.linalg import norm

from jaxlag._lowering._symbolic._program_key import Key
from jaxlag._lowering._verification._compared_state import (
    SLACK,
    Results,
    State,
    random_state,
)

STATES = 8  # random states at which both programs are compared
LEAST = 6  # least number of comparable states
DRAWS = 32  # largest number of states drawn
NUDGES = 3  # changes of q and v by one rounding each, if the slack is exceeded
SENSITIVE = 1e-3  # relative change of an acceleration by a nudge beyond which a state is not used


class Verification(NamedTuple):
    """The comparison of a program with the array program.

    Attributes:
        states: number of compared states.
        difference: the largest, in units of SLACK roundings; inf if only one has a value.
    """

    states: int
    difference: float

    @property
    def message(self) -> str:
        """The result as text."""
        if not self.difference <= 1.0:
            if np.isinf(self.difference):
                return "differs from the array program: only one of them is finite"
            return f"differs from the array program by {SLACK * self.difference:.1e} roundings"
        if self.states < LEAST:
            return f"only {self.states} of {DRAWS} random states to compare with the array program"
        return f"equal to the array program at {self.states} random states"

    @property
    def sound(self) -> bool:
        """Whether they are equal at enough states."""
        return bool(self.difference <= 1.0) and self.states >= LEAST

    def and_of(self, other: "Verification") -> "Verification":
        """The result of both comparisons."""
        return Verification(min(self.states, other.states), max(self.difference, other.difference))


def compare(
    key: Key, results: Callable[[State], Results | None], known: list | None
) -> Verification:
    """Compare two programs with the known params and with random ones.

    Known params may be special, and random ones may be impossible for a system: both are used,
    until there are enough states. If the array program has no value, the other must have none.

    Args:
        key: key of the scalar program.
        results: of both at a state; None if it cannot be used.
        known: leaves of the params; None if they are unknown.
    """
    rng = np.random.default_rng(0)
    eps = float(jnp.finfo(key.dtype).eps)

    def drawn(from_known: bool) -> float | None:
        """The difference at one more state; None if there is nothing to compare."""
        at = random_state(key, rng, known if from_known else None)
        right = results(at)
        if right is None:
            return None
        found = right.found
        if not right.defined:
            return np.inf if np.all(np.isfinite(found)) else None
        off = float(np.max(np.abs(found - right.x) / right.allowed, initial=0.0))
        if 1.0 < off < np.inf:
            # Sines of a million lose digits in both programs: as many as a nudge changes.
            change = 0.0
            for _ in range(NUDGES):
                signs = [1.0 + eps * rng.choice([-1.0, 1.0], x.size) for x in (at.q, at.v)]
                near = results(at._replace(q=at.q * signs[0], v=at.v * signs[1]))
                if near is None or near.x.shape != right.x.shape:
                    return None
                change = max(change, float(np.max(np.abs(near.x - right.x))))
            if change > SENSITIVE * norm(right.x):
                return None
            off = float(np.max(np.abs(found - right.x) / (right.allowed + SLACK * change)))
        return off if np.isfinite(off) else np.inf

    compared, worst = 0, 0.0
    for from_known, wanted in (
        ((True, STATES), (False, STATES // 2)) if known else ((False, STATES),)
    ):
        states, wanted = 0, max(wanted, LEAST - compared)
        for _ in range(DRAWS):
            off = drawn(from_known)
            if off is not None:
                worst = max(worst, off)
                states += bool(np.isfinite(off))
            if states == wanted or worst > 1.0:
                break
        compared += states
    return Verification(compared, worst)
