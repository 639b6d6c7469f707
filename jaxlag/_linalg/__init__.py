"""Linear algebra of mechanics: the mass matrix, constraint rows, projections."""

from typing import NoReturn

from jaxlag._core._old_layout import missing


def __getattr__(name: str) -> NoReturn:
    missing(__name__, name)
