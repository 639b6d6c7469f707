"""Reference motions of the systems, to 20 digits or more.

Each system that moves has a file in `bench/references/` with two motions, from the starts in
`bench._problems.starts`. The equations are plain derivatives of the declaration (`equations`), in
50 digits. They are integrated by extrapolation of order 26 to 1e-26 per step. The engine is not
used. A second integration has another order and tolerance. The file holds the largest difference
of the two, which shows the accuracy of the first.

    python -m bench._multiprecision.make_references                     all, in half an hour
    python -m bench._multiprecision.make_references double_pendulum     some
    python -m bench._multiprecision.make_references --check [NAME ...]  make them again and compare

Needs gmpy2 (`pip install "jaxlag[bench]"`).
"""

import json
import sys
from argparse import ArgumentParser
from collections.abc import Mapping, Sequence
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import jax
import numpy as np

from bench._multiprecision.equations import DIGITS, Motion
from bench._multiprecision.extrapolation import integrated
from bench._problems.starts import STARTS, Start

MODULE = "bench._multiprecision.make_references"
FOLDER = Path(__file__).parents[1] / "references"
SAVES = 33
STORED_DIGITS = 25  # digits in the files
COLUMNS, TOLERANCE = 13, 1e-26
OTHER_COLUMNS, OTHER_TOLERANCE = 11, 1e-24
AGREEMENT = 1e-18  # of the two integrations, relative to 1 + |y|


class Reference(NamedTuple):
    """One motion, as the benchmarks read it.

    Attributes:
        start: name of the start.
        times: (s,), s.
        y: (s, 2n), the doubles nearest to (q, v).
        agreement: largest difference of the two integrations, relative to 1 + |y|.
    """

    start: str
    times: np.ndarray
    y: np.ndarray
    agreement: float


def load(name: str, folder: Path = FOLDER) -> tuple[Mapping[str, Any], list[Reference]]:
    """(parameters, motions) of a file."""
    content = json.loads((folder / f"{name}.json").read_text())
    motions = [
        Reference(
            motion["start"],
            np.array(motion["times"]),
            np.array([[float(x) for x in (*q, *v)] for q, v in _states(motion)]),
            motion["agreement"],
        )
        for motion in content["motions"]
    ]
    return content["params"], motions


def made(system: Any, params: Mapping[str, Any], starts: Sequence[Start]) -> list[dict[str, Any]]:
    """The motions of a system, as written to its file."""
    motion = Motion(system, params)
    return [_followed(motion, start) for start in starts]


def _followed(motion: Motion, start: Start) -> dict[str, Any]:
    times = [start.duration * i / (SAVES - 1) for i in range(SAVES)]
    y = motion.start(start.q0, start.v0)
    states, steps = integrated(motion.rates, y, times, TOLERANCE, COLUMNS)
    others, _ = integrated(motion.rates, y, times, OTHER_TOLERANCE, OTHER_COLUMNS)
    n = motion.size
    return {
        "start": start.name,
        "times": times,
        "q": [[_digits(x) for x in state[:n]] for state in states],
        "v": [[_digits(x) for x in state[n:]] for state in states],
        "steps": steps,
        "agreement": float(f"{largest_difference(states, others):.1e}"),
    }


def largest_difference(states: Sequence[Sequence], others: Sequence[Sequence]) -> float:
    """Largest difference relative to 1 + |y|."""
    pairs = [(a, b) for x, y in zip(states, others, strict=True) for a, b in zip(x, y, strict=True)]
    return max(float(abs(a - b) / (1 + abs(a))) for a, b in pairs)


def differences(motion: Mapping[str, Any], recomputed: Mapping[str, Any]) -> float:
    """Largest difference of a motion of a file and the same made again, relative to 1 + |y|."""
    if motion["times"] != recomputed["times"] or motion["start"] != recomputed["start"]:
        return float("inf")
    import gmpy2

    def numbers(motion: Mapping[str, Any]) -> list[list]:
        return [[gmpy2.mpfr(x) for x in (*q, *v)] for q, v in _states(motion)]

    return largest_difference(numbers(motion), numbers(recomputed))


def _states(motion: Mapping[str, Any]) -> Any:
    return zip(motion["q"], motion["v"], strict=True)


def _digits(x: Any) -> str:
    return f"{x:.{STORED_DIGITS - 1}e}"


def _entries() -> Mapping[str, Any]:
    from systems.catalogue import ENTRIES

    return {name: entry for name, entry in ENTRIES.items() if entry.kind == "trajectory"}


def plain(params: Mapping[str, Any]) -> dict[str, Any]:
    """Parameters as stored in the files: numbers and lists."""
    return {name: np.asarray(value).tolist() for name, value in params.items()}


def main(argv: Sequence[str] | None = None) -> int:
    """Make references, or check them; 0 if all agree with themselves and with the files."""
    parser = ArgumentParser(prog=f"python -m {MODULE}", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="systems; by default all")
    parser.add_argument("--check", action="store_true", help="compare with the files, write none")
    arguments = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    entries, good = _entries(), True
    for name in arguments.names or entries:
        begin, entry = perf_counter(), entries[name]
        try:
            motions = made(entry.system, entry.example.params, STARTS[name])
        except ArithmeticError as error:  # continue with the others
            print(f"{name:<36} {error}", flush=True)
            good = False
            continue
        deviations = [motion["agreement"] for motion in motions]
        if arguments.check:
            stored = json.loads((FOLDER / f"{name}.json").read_text())["motions"]
            pairs = zip(stored, motions, strict=True)
            deviations += [differences(*pair) for pair in pairs]
        else:
            _write(name, entry, motions)
        fine = max(deviations) <= AGREEMENT
        good = good and fine
        seconds = perf_counter() - begin
        verdict = "ok" if fine else "NOT TRUSTED"
        print(f"{name:<36} {max(deviations):.1e} {verdict:<11} {seconds:6.1f} s", flush=True)
    return 0 if good else 1


def _write(name: str, entry: Any, motions: list[dict[str, Any]]) -> None:
    content = {
        "system": name,
        "made_by": f"python -m {MODULE} {name}",
        "arithmetic": f"gmpy2.mpfr, {DIGITS} digits; {STORED_DIGITS} digits kept",
        "integration": f"extrapolated midpoint rule, order {2 * COLUMNS}, {TOLERANCE:g} per step",
        "params": plain(entry.example.params),
        "motions": motions,
    }
    FOLDER.mkdir(exist_ok=True)
    (FOLDER / f"{name}.json").write_text(json.dumps(content, indent=0) + "\n")


if __name__ == "__main__":
    sys.exit(main())
