"""Errata of chapter 1, in the order of the book."""

from jaxlag.rotation import direction_cosines
from systems.errata import _attitude as attitude
from systems.errata._erratum import Erratum, State, around


def _left_to_complete(s: State):
    """Last term of the scalar product of the first two columns of T_B/I, which is zero."""
    A = direction_cosines(attitude.rotation_matrix(s.q))
    return -(A[0, 0] * A[0, 1] + A[1, 0] * A[1, 1])


def _last_term(s: State, column: int):
    A = attitude.direction_cosines(s.q)
    return A[2, 0] * A[2, column]


ERRATA = (
    Erratum(
        place="Text after 1.15, last term of i1.i2 = 0",
        wrong="a31 a31 for a31 a32",
        draw=around({}, (0.5, 0.4, 0.7)),
        engine=_left_to_complete,
        printed=lambda s: _last_term(s, 0),
        right=lambda s: _last_term(s, 1),
    ),
)

TEXT_ONLY = (("Text after 1.12, u_z", "omega_x y - omega_y x belongs in both places"),)
