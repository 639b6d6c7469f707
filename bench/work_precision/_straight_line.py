"""Source code of equations: one line for each operation, without repetitions.

Numba and plain Python use the equations of `_problems.explicit_equations` in this form.
"""

from collections.abc import Mapping
from typing import Any

from bench._problems.explicit_equations import Functions, Rates


class _Line:
    """A number with a name in the code."""

    def __init__(self, code: "_Code", name: str) -> None:
        self.code, self.name = code, name

    def __add__(self, other: Any) -> "_Line":
        return self.code.line("+", self, other)

    def __radd__(self, other: Any) -> "_Line":
        return self.code.line("+", other, self)

    def __sub__(self, other: Any) -> "_Line":
        return self.code.line("-", self, other)

    def __rsub__(self, other: Any) -> "_Line":
        return self.code.line("-", other, self)

    def __mul__(self, other: Any) -> "_Line":
        return self.code.line("*", self, other)

    def __rmul__(self, other: Any) -> "_Line":
        return self.code.line("*", other, self)

    def __truediv__(self, other: Any) -> "_Line":
        return self.code.line("/", self, other)

    def __rtruediv__(self, other: Any) -> "_Line":
        return self.code.line("/", other, self)

    def __neg__(self) -> "_Line":
        return self.code.named(f"-{self.name}")


class _Code:
    def __init__(self) -> None:
        self.lines: list[str] = []
        self.known: dict[str, _Line] = {}

    def named(self, expression: str) -> _Line:
        if expression not in self.known:
            name = f"x{len(self.lines)}"
            self.lines.append(f"{name} = {expression}")
            self.known[expression] = _Line(self, name)
        return self.known[expression]

    def line(self, operator: str, a: Any, b: Any) -> _Line:
        return self.named(f"{_operand(a)} {operator} {_operand(b)}")

    def function(self, name: str) -> Any:
        return lambda x: self.named(f"{name}({_operand(x)})")


def _operand(x: Any) -> str:
    return x.name if isinstance(x, _Line) else f"({float(x)!r})"


def source(rates: Rates, params: Mapping[str, Any], size: int, name: str = "rates") -> str:
    """A function `name(t, y, out)` that writes the rates into `out` and returns it.

    It calls sin, cos and sqrt, which must be in its namespace.
    """
    code = _Code()
    sin, cos, sqrt = (code.function(function_name) for function_name in ("sin", "cos", "sqrt"))
    functions = Functions(sin, cos, sqrt, lambda x: 1.0 / (x * sqrt(x)))
    ends = rates(functions, params, [_Line(code, f"y{i}") for i in range(size)])
    body = [f"y{i} = y[{i}]" for i in range(size)]
    body += code.lines + [f"out[{i}] = {_operand(x)}" for i, x in enumerate(ends)] + ["return out"]
    return f"def {name}(t, y, out):\n" + "".join(f"    {line}\n" for line in body)
