"""The result of a comparison, and the allowed difference."""

from typing import NamedTuple

SLACK = 100.0  # times the change by other rounding errors, or the rounding error of the result


class Compared(NamedTuple):
    """The result of comparing one system.

    Attributes:
        kind: "equal", "differs", or the reason why nothing was compared.
        worst: the largest difference divided by the allowed one.
        what: the quantity with this difference.
    """

    kind: str
    worst: float = 0.0
    what: str = ""


EQUAL = "equal"
DIFFERS = "differs"


def worst(found: dict[str, float]) -> Compared:
    """The quantity that differs most; `found` holds differences divided by the allowed ones."""
    what, most = max(found.items(), key=lambda pair: pair[1], default=("", 0.0))
    return Compared(DIFFERS if not most <= 1.0 else EQUAL, most, what)
