"""Command line: `python -m bench list | NAME [--quick] [options of that benchmark]`."""

import math
import sys
from argparse import ArgumentParser
from collections.abc import Sequence
from difflib import get_close_matches
from importlib import import_module
from inspect import signature
from typing import Any

import jax

from bench._harness import results
from bench._harness.timing import BENCHMARKS
from bench.fits._data import DataError

_PARTS = {"system", "seconds", "first"}
"""Options with which a run is a part of a whole one, so that it does not replace its results."""
_BOUNDS = (
    ("seconds", lambda x: 0 < x < math.inf, "a positive number of seconds"),
    ("first", lambda x: x >= 0, "a seed, 0 or more"),
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one benchmark; 0 if every target was met, 1 if one was missed, 2 if none could run."""
    parser = ArgumentParser(prog="python -m bench", description="Measure jaxlag.")
    parser.add_argument("name", metavar="NAME", help="a benchmark, or 'list'")
    parser.add_argument("--quick", action="store_true", help="fewer cases and repeats: a minute")
    parser.add_argument(
        "--system", action="append", help="of work-precision: this system alone (repeatable)"
    )
    parser.add_argument("--seconds", type=float, help="of fuzz: how long to try")
    parser.add_argument("--first", type=int, help="of fuzz: the first seed")
    parser.add_argument("--python", help="of work-precision: an interpreter with another jax")
    parser.add_argument("--data", help="of fits: the folder of recordings (else JAXLAG_DATA)")
    arguments = parser.parse_args(argv)
    names = ("system", "python", "seconds", "first", "data")
    options = {name: vars(arguments)[name] for name in names}
    options = {name: value for name, value in options.items() if value is not None}
    if arguments.name == "list":
        for name in BENCHMARKS:
            print(f"{name:<14} {_headline(name)}")
        return 0
    if arguments.name not in BENCHMARKS:
        near = get_close_matches(arguments.name, BENCHMARKS, n=3)
        hint = f"Did you mean {' or '.join(near)}?" if near else f"Known: {', '.join(BENCHMARKS)}."
        print(f"NAME must be a benchmark, but it was {arguments.name!r}. {hint}", file=sys.stderr)
        return 2
    run = _module(arguments.name).run
    foreign = [name for name in options if name not in signature(run).parameters]
    if foreign:
        print(f"{arguments.name} has no option --{foreign[0]}.", file=sys.stderr)
        return 2
    for name, fits, must in _BOUNDS:
        if name in options and not fits(options[name]):
            print(f"--{name} must be {must}, but it was {options[name]}.", file=sys.stderr)
            return 2
    jax.config.update("jax_enable_x64", True)
    circumstances = results.circumstances()
    try:
        report = run(arguments.quick, **options)
    except DataError as error:
        print(error, file=sys.stderr)
        return 2
    if not report.rows:
        print(f"{arguments.name} measured nothing, so that nothing is written.", file=sys.stderr)
        return 2
    path = results.save(
        arguments.name,
        _headline(arguments.name),
        report,
        circumstances,
        arguments.quick or bool(_PARTS & options.keys()),
        results.FOLDER,
    )
    print(results.text(report))
    print(f"\nwritten to {path}")
    return 0 if all(target.met for target in report.targets) else 1


def _module(name: str) -> Any:
    return import_module(f"bench.{name.replace('-', '_')}")


def _headline(name: str) -> str:
    return (_module(name).__doc__ or "").splitlines()[0]


if __name__ == "__main__":
    sys.exit(main())
