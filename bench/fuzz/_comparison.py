"""How a program compares, and what it is allowed to differ by."""

from typing import NamedTuple

SLACK = 100.0  # times what other roundings change, or roundings of the result


class Compared(NamedTuple):
    """How one system compares.

    Attributes:
        kind: "equal", "differs", or why there is nothing to compare.
        worst: the largest difference over what is allowed.
        what: which quantity it is in.
    """

    kind: str
    worst: float = 0.0
    what: str = ""


EQUAL = "equal"
DIFFERS = "differs"


def worst(found: dict[str, float]) -> Compared:
    """What differs most, by quantity: differences over what is allowed."""
    what, most = max(found.items(), key=lambda pair: pair[1], default=("", 0.0))
    return Compared(DIFFERS if not most <= 1.0 else EQUAL, most, what)
