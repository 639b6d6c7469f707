"""Problems without time stepping: assembly, equilibria, inverse dynamics."""

from typing import NoReturn

from jaxlag._core._old_pickles import missing


def __getattr__(name: str) -> NoReturn:
    missing(__name__, name)
