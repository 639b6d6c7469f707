"""Errata of chapters 1 to 4 of Pila's book, each shown numerically: `python -m systems errata`.

Every wrong printed formula and its correction are evaluated at a few random states. Both are
compared with the values that `jaxlag` computes there by differentiation, from positions, energies
and points of application. The error of a formula is its largest deviation over these states and
all its components, in units of the largest value of the engine.
"""

from argparse import ArgumentParser
from collections.abc import Sequence

import numpy as np

from systems.errata import (
    _chapter1,
    _chapter2,
    _chapter3_from_120,
    _chapter3_to_119,
    _chapter4_body_axes,
    _chapter4_flight,
    _chapter4_to_70,
    _tricycle,
)
from systems.errata._erratum import Erratum as Erratum
from systems.errata._erratum import Errors, examine

TOLERANCE = 64 * float(np.finfo(float).eps)
"""Largest error of a right formula: rounding in about ten terms, each larger than their sum."""

WRONG = 1e-6
"""An error above this is not a rounding error."""

ERRATA: tuple[Erratum, ...] = (
    *_chapter1.ERRATA,
    *_chapter2.ERRATA,
    *_chapter3_to_119.ERRATA,
    *_chapter3_from_120.ERRATA,
    *_chapter4_to_70.ERRATA,
    *_tricycle.ERRATA,
    *_chapter4_body_axes.ERRATA,
    *_chapter4_flight.ERRATA,
)
"""The misprints that change a value, in the order of the book."""

TEXT_ONLY: tuple[tuple[str, str], ...] = (
    *_chapter1.TEXT_ONLY,
    *_chapter2.TEXT_ONLY,
    *_chapter3_to_119.TEXT_ONLY,
    *_chapter3_from_120.TEXT_ONLY,
    *_chapter4_to_70.TEXT_ONLY,
    *_tricycle.TEXT_ONLY,
    *_chapter4_body_axes.TEXT_ONLY,
    *_chapter4_flight.TEXT_ONLY,
)
"""(place, remark) of misprints in words and symbols that do not change a value."""


def confirmed(errors: Errors) -> bool:
    """Whether the right formula agrees with the engine and the printed one does not."""
    return errors.right <= TOLERANCE and errors.printed > WRONG


def main(argv: Sequence[str]) -> int:
    """Evaluate and print all errata; 0 if every one of them is confirmed."""
    _parser().parse_args(argv)
    widths = [max(len(getattr(e, name)) for e in ERRATA) for name in ("place", "wrong")]
    print(_row(widths, "place", "what is wrong", "printed", "right"))
    failed = 0
    for erratum in ERRATA:
        errors = examine(erratum)
        failed += not confirmed(errors)
        verdict = "" if confirmed(errors) else "  FAIL"
        numbers = f"{errors.printed:.1e}", f"{errors.right:.1e}"
        print(_row(widths, erratum.place, erratum.wrong, *numbers) + verdict, flush=True)
    print("\nin words and signs only, without a value of its own")
    for place, remark in TEXT_ONLY:
        print(f"{place}: {remark}")
    verdict = f"{failed} not confirmed" if failed else "all confirmed"
    print(f"\nevaluated {len(ERRATA)}: {verdict}; in words only {len(TEXT_ONLY)}")
    return 1 if failed else 0


def _row(widths: Sequence[int], place: str, wrong: str, printed: str, right: str) -> str:
    return f"{place:<{widths[0]}}  {wrong:<{widths[1]}}  {printed:>8}  {right:>8}"


def _parser() -> ArgumentParser:
    return ArgumentParser(
        prog="python -m systems errata",
        description="The book's misprints in chapters 1 to 4, with the errors of the printed and "
        "of the right formula against the engine, relative to its largest value.",
    )
