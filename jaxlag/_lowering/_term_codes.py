"""Straight-line code for single terms of the equations."""

from collections.abc import Mapping
from typing import NamedTuple

from jaxlag._lowering._graph._straight_line import Program

LONG = 500
"""Lines of all terms from which they are interpreted. Arrays compile quicker for shorter ones."""


class TermCodes(NamedTuple):
    """Code for M, h, A, gamma, phi, its rows of A, and A v + b.

    Attributes:
        programs: by the name of the term.
    """

    programs: Mapping[str, Program]

    def __hash__(self) -> int:
        return id(self.programs)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, TermCodes) and self.programs is other.programs

    @property
    def are_long(self) -> bool:
        """Whether the interpreter is quicker to compile than the same terms on arrays."""
        return sum(len(p.body) + len(p.prelude) for p in self._started) > LONG

    @property
    def _started(self) -> list[Program]:
        """The code that starts of motions evaluate."""
        return [program for name, program in self.programs.items() if name != "bias"]
