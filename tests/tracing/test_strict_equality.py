"""Static values that compare equal but differ: each has its own program."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import pytest

import jaxlag as jl


class Static(eqx.Module):
    law: Any = eqx.field(static=True)


@dataclass(frozen=True)
class Frozen:
    k: Any


class First(NamedTuple):
    x: float = 1.0

    def k(self):
        return 2.0


class Second(NamedTuple):
    x: float = 1.0

    def k(self):
        return 5.0


@pytest.mark.parametrize(
    ("law", "one", "other"),
    [
        (lambda law: law.k(), First(), Second()),
        (lambda law: 2.0 if law is True else 5.0, True, 1),
        (lambda law: 2.0 if type(law.k) is int else 5.0, Frozen(1), Frozen(1.0)),
        (lambda law: 2.0 if str(law[0]) == "-0.0" else 5.0, (-0.0,), (0.0,)),
    ],
)
def test_equal_but_different_values_have_separate_programs(law, one, other):
    """Keys that compare equal: named tuples of two classes, True and 1, 0.0 and -0.0."""
    system = jl.System(lambda t, q, v, p: 0.5 * v @ v - law(p["x"].law) * q[0], ("x",))
    found = [system.acceleration([0.0], [0.0], {"x": Static(x)})[0] for x in (one, other)]
    assert found == [-2.0, -5.0]
