"""Error messages in one form: argument, requirement, given value, likely fix."""

import re
from typing import Any

_MANY = 8
"""Numbers of an array that are shown; of longer arrays the first and the last three are shown."""
_EXPRESSION = re.compile(r"[A-Za-z_]\w*(\.\w+|\[[^\]]+\])*(=\S+)?")
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?j?|nan|inf|True|False")
_ONLY_NUMBERS = re.compile(r"[-+\d.eEjnaifTruFls,\s\[\]]*")
_TRACER = re.compile(r"\b\w*Tracer\(")
_SHAPE = re.compile(r"\b[a-z]+\d*\[[^\]]*\]")
_QUOTED = re.compile(r"(`[^`\n]*`|'[^'\n]*'|\"[^\"\n]*\")")


class SimulationError(RuntimeError):
    """A simulation ended with a status other than `Status.ok`.

    Attributes:
        motion: the `Solution` up to the failure; rows that were not reached are NaN.
    """

    def __init__(self, message: str, motion: object = None) -> None:
        super().__init__(message)
        self.motion = motion


class EquilibriumError(RuntimeError):
    """A search for a state of rest, or for a steady motion, found none.

    Attributes:
        equilibrium: the `Equilibrium` with the nearest point and its unbalanced forces, or the
            `SteadyMotion` with the nearest state and what does not hold.
    """

    def __init__(self, message: str, equilibrium: object = None) -> None:
        super().__init__(message)
        self.equilibrium = equilibrium


class AssemblyError(RuntimeError):
    """No nearby state satisfies the constraints.

    Attributes:
        assembly: the `Assembly` with the nearest state and its residuals.
    """

    def __init__(self, message: str, assembly: object = None) -> None:
        super().__init__(message)
        self.assembly = assembly


def requirement(argument: str, must: str, was: str, fix: str = "") -> str:
    """`<argument> must <must>, but <was>. <fix>`; arrays in it are shortened.

    A name, or an expression of one, is written in back-ticks; words before a colon are the owner
    of the argument.
    """
    return shortened(f"{_ticked(argument)} must {must}, but {was}.") + (f" {fix}" if fix else "")


def invalid(argument: str, must: str, was: str, fix: str = "") -> ValueError:
    """A `ValueError` in the form of `requirement`, to be raised by the caller."""
    return ValueError(requirement(argument, must, was, fix))


def unsupported(what: str, why: str, fix: str = "") -> ValueError:
    """`<what> is not supported: <why>. <fix>`, a `ValueError` to be raised by the caller."""
    return ValueError(shortened(f"{what} is not supported: {why}.") + (f" {fix}" if fix else ""))


def shortened(text: Any) -> str:
    """The text; of arrays of more than 8 numbers the first and the last three alone.

    Quoted parts, such as lines of code, stay as they are. JAX's names of traced values are replaced
    by their shapes.
    """
    parts = _QUOTED.split(_without_tracers(str(text)))
    return "".join(part if k % 2 else _without_arrays(part) for k, part in enumerate(parts))


def _without_tracers(text: str) -> str:
    """The text with "a traced float64[2]" in the place of "JitTracer(float64[2])"."""
    while (found := _TRACER.search(text)) is not None:
        begin, end, depth = found.start(), found.end(), 1
        while depth and end < len(text):
            depth += {"(": 1, ")": -1}.get(text[end], 0)
            end += 1
        shape = _SHAPE.search(text, begin, end)
        text = f"{text[:begin]}a traced {shape[0] if shape else 'value'}{text[end:]}"
    return text


def _without_arrays(text: str) -> str:
    """The same of a text without quotes, in one pass."""
    found, depth, begin, end = [], 0, 0, 0
    for k, letter in enumerate(text):
        if letter == "[":
            begin, depth = (k if depth == 0 else begin), depth + 1
        elif letter == "]" and depth:
            depth -= 1
            if depth == 0:
                found += [text[end:begin], _few(text[begin : k + 1])]
                end = k + 1
    return "".join([*found, text[end:]])


def _few(array: str) -> str:
    numbers = _NUMBER.findall(array) if _ONLY_NUMBERS.fullmatch(array) else ()
    if len(numbers) <= _MANY:
        return array
    first, last = ", ".join(numbers[:3]), ", ".join(numbers[-3:])
    return f"[{first}, ..., {last}] ({len(numbers)} numbers)"


def _ticked(argument: str) -> str:
    owner, colon, own = argument.rpartition(": ")
    names = own.split(" and ")
    if all(_EXPRESSION.fullmatch(name) for name in names):
        own = " and ".join(f"`{name}`" for name in names)
    return f"{owner}{colon}{own}"
