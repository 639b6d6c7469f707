"""Final coordinates of the motions of the benchmark `work-precision`, to 20 digits.

`python -m bench._problems.exact_ends` computes them again by heyoka in quadruple precision (113
bits). The starts are exact doubles. With a tolerance of 1e-30 all stored digits are correct, even
if the motion amplifies differences by 1e6.
"""

import json
import sys
from decimal import Context, Decimal
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from bench._problems.explicit_equations import of_expressions
from bench._problems.motions import MOTIONS, Motion

PATH = Path(__file__).parents[1] / "references" / "work_precision" / "ends.json"
DIGITS = 20
TOLERANCE = 1e-30


def exact_end(name: str) -> np.ndarray:
    """Coordinates at the end, (n,) or (lanes, n)."""
    numbers = json.loads(PATH.read_text())["ends"][name]
    return np.array(numbers, dtype=np.float64)


def computed(motion: Motion) -> list[Any]:
    """The final coordinates as decimal strings, computed."""
    if motion.lanes == 1:
        return _end(motion, motion.start())
    return [_end(motion, y0) for y0 in motion.start()]


def _end(motion: Motion, y0: np.ndarray) -> list[str]:
    hy = import_module("heyoka")
    number = hy.real128
    names = hy.make_vars(*(f"y{i}" for i in range(len(y0))))
    params = {name: _wide(value, hy) for name, value in motion.params.items()}
    rates = motion.rates(of_expressions(hy), params, names)
    zero = hy.expression(number(0))
    system = [(name, zero + rate) for name, rate in zip(names, rates, strict=True)]
    start = np.array([number(float(y)) for y in y0])
    tool = hy.taylor_adaptive(
        system, start, tol=number(TOLERANCE), fp_type=number, compact_mode=True
    )
    tool.propagate_until(number(float(motion.t1)))
    return [_decimal(x) for x in tool.state[: motion.q0.shape[-1]]]


def _wide(value: Any, hy: Any) -> Any:
    """Parameters as expressions: results computed from them are not rounded to double precision."""
    if np.ndim(value):
        return [_wide(x, hy) for x in value]
    return hy.expression(hy.real128(float(value)))


def _decimal(x: Any) -> str:
    return str(Context(prec=DIGITS).plus(Decimal(str(x))))


def main(names: list[str]) -> None:
    content = json.loads(PATH.read_text()) if PATH.exists() else {"ends": {}}
    content["made"] = "python -m bench._problems.exact_ends: heyoka, 113 bits, tolerance 1e-30"
    for name in names or MOTIONS:
        content["ends"][name] = computed(MOTIONS[name]())
        print(name, content["ends"][name] if len(content["ends"][name]) < 9 else "")
        PATH.parent.mkdir(parents=True, exist_ok=True)
        PATH.write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    import jax

    jax.config.update("jax_enable_x64", True)
    main(sys.argv[1:])
