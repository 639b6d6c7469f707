"""Command line: `python -m systems list | run NAME | check FILE.json | errata | fit-pendulum`."""

import sys
from argparse import ArgumentParser
from collections.abc import Sequence
from pathlib import Path

import jax

from systems import _run
from systems.catalogue import ENTRIES, UnknownSystem, find
from systems.reference import _check


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return the exit status: 0 if all went well."""
    jax.config.update("jax_enable_x64", True)
    argv = sys.argv[1:] if argv is None else list(argv)
    if argv[:1] == ["fit-pendulum"]:
        from systems import fit_pendulum

        return fit_pendulum.main(argv[1:])
    if argv[:1] == ["errata"]:
        from systems import errata

        return errata.main(argv[1:])
    arguments = _parser().parse_args(argv)
    if arguments.command == "check":
        return _check.main(arguments.files)
    if arguments.command == "list":
        return _list()
    try:
        entry = find(arguments.name)
    except UnknownSystem as error:
        print(error, file=sys.stderr)
        return 1
    return _run.main(entry, arguments.plot)


def _parser() -> ArgumentParser:
    parser = ArgumentParser(
        prog="python -m systems",
        description='Systems of Pila, "Introduction to Lagrangian Dynamics", and a few beyond.',
    )
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("list", help="names, coordinates and places in the book")
    run = commands.add_parser("run", help="simulate the example of a system")
    run.add_argument("name", metavar="NAME")
    run.add_argument("--plot", type=Path, metavar="FILE", help="write a figure (.png, .pdf, .svg)")
    check = commands.add_parser("check", help="compare reference files with the simulation")
    check.add_argument("files", nargs="+", type=Path, metavar="FILE.json")
    commands.add_parser("errata", help="evaluate the misprints of chapters 1 to 4")
    commands.add_parser("fit-pendulum", help="identify a pendulum from measured motion")
    return parser


def _list() -> int:
    for name, entry in ENTRIES.items():
        print(f"{name:<32} {', '.join(entry.coordinates):<16} {entry.book}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
