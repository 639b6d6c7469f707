"""`check_derivatives`: checks of the derivatives of a declared system."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxlag._core._arguments import state_first
from jaxlag._core._arrays import concrete, number
from jaxlag._core._errors import invalid
from jaxlag._model._coordinates import state_vectors
from jaxlag._model._inputs import check_inputs, check_range, evaluate
from jaxlag._system._declared_functions import Declared, Params, declared
from jaxlag._system._inspection import check_traceable
from jaxlag._system._nan_origins import Origin
from jaxlag._system._nonfinite import HINTS
from jaxlag._system._system import System
from jaxlag.testing import _compare_modes as _check
from jaxlag.testing import _states

STATES = _states.STATES
"""States examined by `check_derivatives`."""

_MASKED = (
    "Only its reverse derivative is not finite: a where() leaves the value out, but multiplies the "
    "derivative by zero. Give it an argument that is safe: where(ok, f(where(ok, x, 1.0)), ...)."
)
_BATCHED = (
    "Under vmap only: it computes both branches of a choice, and uses the batching rules of "
    "custom_vmap. Make the branch that is not chosen, or those rules, finite as well."
)


@dataclass(frozen=True)
class Finding:
    """A derivative that is nonfinite or wrong at one state.

    Attributes:
        function: the declared function: "lagrangian", "force 'drag': Q", ...
        kind: "not finite", or "wrong" if two ways to compute one derivative disagree.
        order: order of the derivative; 0 for the value itself.
        variables: variables of the derivative, as few arguments as necessary: "q", "q or v" if
            each alone is sufficient, "q and params" for a mixed one; "" for a value.
        state: name of the state.
        q: coordinates there, m or rad.
        v: velocities there, m/s or rad/s; quasi-velocities for a function of them.
        vmapped: whether it occurs only under `jax.vmap`.
        mode: "value", "forward", "reverse" (taken first), or "reverse twice" (first and last).
        primitive: JAX's name of the operation that produces it; "" if unknown.
        file: file of the user's code with that operation; "" if unknown.
        line: line of this file; 0 if unknown.
        hint: remedy, or the numbers that disagree.
    """

    function: str
    kind: str
    order: int
    variables: str
    state: str
    q: tuple[float, ...]
    v: tuple[float, ...]
    vmapped: bool
    mode: str
    primitive: str
    file: str
    line: int
    hint: str

    @property
    def where(self) -> str:
        """`sqrt at model.py:17`, if it is known."""
        place = f" at {Path(self.file).name}:{self.line}" if self.file else ""
        return (self.primitive or "an operation without a name") + place

    def __str__(self) -> str:
        by = f" in {self.variables}" * bool(self.variables)
        what = f"derivative of order {self.order}{by}" if self.order else "value"
        vmapped = " under vmap" * self.vmapped
        first = f", first in {self.where}" if self.kind == "not finite" or self.primitive else ""
        return f"{self.function}: {what} {self.kind} at {self.state}{vmapped}{first}. {self.hint}"


@dataclass(frozen=True)
class Report:
    """The result of `check_derivatives`; `print` shows it as a table.

    Attributes:
        findings: by function and state; empty if all is well.
        functions: (name, order) of the examined functions.
        states: name -> (q, v).
        omitted: function -> derivatives that could not be computed, and why.
    """

    findings: tuple[Finding, ...]
    functions: tuple[tuple[str, int], ...]
    states: Mapping[str, tuple[tuple[float, ...], tuple[float, ...]]]
    omitted: Mapping[str, str]

    @property
    def ok(self) -> bool:
        """Whether every computed derivative is finite and correct."""
        return not self.findings

    def __str__(self) -> str:
        lines = [
            "derivatives of " + ", ".join(f"{name} (order {k})" for name, k in self.functions),
            "at " + ", ".join(self.states),
            *(f"{name}: {why}" for name, why in self.omitted.items()),
        ]
        if self.ok:
            return "\n".join([*lines, "all are finite and agree"])
        same: dict[Finding, list[str]] = {}
        for finding in self.findings:
            same.setdefault(replace(finding, state="", q=(), v=()), []).append(finding.state)
        head = ("function", "order", "in", "what", "where", "states")
        rows = [
            (f.function, str(f.order), f.variables, f.kind, f.where, ", ".join(states))
            for f, states in same.items()
        ]
        widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
        for row, hint in zip([head, *rows], ["", *(f.hint for f in same)], strict=True):
            cells = zip(row, widths, strict=True)
            lines.append("  ".join(x.ljust(width) for x, width in cells).rstrip())
            lines += [f"    {hint}"] * bool(hint)
        return "\n".join(lines)


@state_first
def check_derivatives(
    system: System,
    q: Any,
    v: Any,
    params: Any = None,
    *,
    t: Any = 0.0,
    inputs: Mapping[str, Any] | None = None,
    states: Sequence[str] = STATES,
) -> Report:
    """Find derivatives of a system's functions that are nonfinite or wrong.

    One nonfinite derivative makes a whole acceleration or gradient nonfinite, even if its part is
    small. A wrong one makes it wrong without a message. Every declared function is differentiated
    to one order more than M a + h = Q + A^T lam, A a + gamma = 0 need. So the check covers the
    forward and reverse derivatives of a motion:

    | function                                                   | order |
    |------------------------------------------------------------|-------|
    | `lagrangian`, or `kinetic` and `potential`                 | 3     |
    | `phi` of `Holonomic`, functions of `QuasiVelocities`       | 3     |
    | `residual` of `Pfaffian`                                   | 2     |
    | `position`, `angular_velocity`, `R` of `Rayleigh`          | 2     |
    | `Q`, `force`, `torque`, `rate` of `States`                 | 1     |

    by t, q, v (or u), x of `States`, the real inexact leaves of params, and lam if a force reads it
    (taken as 1), all at once, along dense random directions: forward only, reverse first, and
    reverse first and last; without and with `jax.vmap`. The states:

    | name     | q                                    | v                               |
    |----------|--------------------------------------|---------------------------------|
    | "given"  | as given                             | as given                        |
    | "rest"   | as given                             | 0                               |
    | "zero"   | 0                                    | 0                               |
    | "equal"  | all the entry of q largest in size   | likewise                        |
    | "one"    | the first that entry, the others 0   | likewise                        |
    | "random" | 3 of them, each entry between 1/2 and 3/2 of that given (within 1/2 of 0) |

    with 1 if all of q, or v, is 0: a chain is stretched out at "one" if its angles are
    relative and at "equal" if they are absolute. Repeated states are left out.

    For a nonfinite derivative the report names the operation that produces it, with its line:
    the derivative's program is traced back from its result to an operation whose
    operands are finite. A nonfinite value that a finite result does not contain is no finding. At
    the given and the random states the modes are compared with one another, and each order with
    differences of the order below, (4 D(h/2) - D(h))/3 with central D; a kink is no finding.

    The check includes the changes of a program by vmap, but not XLA's simplifications. Fourth
    derivatives, as Hessians of a motion need, are not checked.

    Args:
        system: the declaration.
        q: coordinates, shape (n,), m or rad; they need not satisfy constraints.
        v: generalized velocities, shape (n,), m/s or rad/s.
        params: as its functions take them.
        t: s.
        inputs: dict from names to input objects or arrays, if forces read them, and the values of
            `States`, which are varied like v.
        states: the states to examine: leave out "zero" if a coordinate cannot be 0.

    Returns:
        The `Report`: `report.ok`, `report.findings`; `print(report)` shows a table.

    Raises:
        ValueError: as `System.check` for functions of wrong shapes; q, v, t or params nonfinite or
            traced; unknown states.

    Source: Griewank, Walther, Evaluating Derivatives, ch. 3 (modes) and 13 (directions); Richardson
    extrapolation: Press et al., Numerical Recipes, sec. 5.7.
    """
    if not isinstance(system, System):
        raise invalid("check_derivatives: system", "be a jl.System", f"it was {system!r}")
    q, v = state_vectors(system.coordinates, q, v)
    t = number("t", "be a number", t, jnp.result_type(float))
    own = Params(params)
    for name, values in (("q", q), ("v", v), ("params", own.leaves)):
        _require_numbers(name, values)
    whole, inputs = own.join(own.leaves), check_inputs(inputs)
    check_range(inputs, t, "t")
    check_traceable(system, whole, q.dtype, evaluate(inputs, t, q, v, whole))
    rows = system._rows(whole, q.dtype)
    fixed = {
        "t": t,
        "params": own.leaves,
        "lam": {name: jnp.ones(shape, q.dtype) for name, shape in rows.shapes},
    }
    u = None if system.quasi is None else system.quasi.of(t, q, v, whole)
    x = None if system.states is None else system.states.flat(evaluate(inputs, t, q, v, whole))
    _require_numbers("u", u)
    _require_numbers("inputs", x)
    at = _states.states(states, q, v, u, x)
    functions = declared(system, own, inputs)
    findings: list[Finding] = []
    omitted: dict[str, str] = {}
    for function in functions:
        arguments = {name: {**fixed, **x} for name, x in at.items()}
        ladder = _check.Ladder(function, next(iter(arguments.values())))
        findings += _Search(function, ladder, arguments).findings()
        if ladder.omitted:
            omitted[function.name] = ladder.omitted
    return Report(
        tuple(findings),
        tuple((f.name, f.role.order + 1) for f in functions),
        {name: (_floats(x["q"]), _floats(x["v"])) for name, x in at.items()},
        omitted,
    )


def _require_numbers(name: str, values: Any) -> None:
    if not concrete(values):
        must = "have concrete values, which the check needs"
        fix = "Call check_derivatives outside jit, vmap and grad."
        raise invalid(f"check_derivatives: {name}", must, "it was traced", fix)
    for x in jax.tree.leaves(values):
        if not np.all(np.isfinite(x)):
            raise invalid(f"check_derivatives: {name}", "be finite", f"it was {values}")


class _Search:
    """The search of one function at all states.

    Args:
        function: the declared function.
        ladder: its derivatives.
        at: name of a state -> all arguments that the function may take.
    """

    def __init__(self, function: Declared, ladder: _check.Ladder, at: Mapping[str, dict]) -> None:
        self.function, self.ladder, self.at = function, ladder, at
        rng = np.random.default_rng(1)
        self.along = {name: _direction(rng, z) for name, z in at.items()}
        # The eps of the least precise of the numbers.
        some = next(iter(at.values()))
        kinds = [x.dtype for x in jax.tree.leaves([some[name] for name in ladder.groups])]
        self.eps = max((float(jnp.finfo(kind).eps) for kind in kinds), default=0.0)

    def findings(self) -> list[Finding]:
        """The lowest order with an error at every state."""
        states = list(self.at)
        smooth = [name for name in states if name == "given" or name.startswith("random")]
        h = _check.step(self.eps)
        points = [self.at[name] for name in states]
        along = [self.along[name] for name in states]
        # Along all arguments at once, and along each alone: a kink in one must not hide another.
        lines = [(name, group) for name in smooth for group in self._groups()]
        for name, group in lines:
            d = self._along(name, group)
            points += [self._shifted(name, s * h, d) for s in (0, 1, -1, 0.5, -0.5)]
            along += [d] * 5
        batch = self.ladder.values(_stack(points), _stack(along), len(points))
        found: list[Finding] = []
        for i, name in enumerate(states):
            alone = self.ladder.values(self.at[name], self.along[name])
            plain, batched = _first(alone), _first(_lane(batch, i))
            if plain is not None:
                found += self._not_finite(name, *plain, vmapped=False)
            if batched is not None and (plain is None or batched[1] < plain[1]):
                found += self._not_finite(name, *batched, vmapped=True)
            if plain is None and name in smooth:
                for k, (own, group) in enumerate(lines):
                    if own != name:
                        continue
                    start = len(states) + 5 * k
                    here, *around = (_lane(batch, j) for j in range(start, start + 5))
                    here = alone if group is None else here
                    wrong = _check.mismatch(here, around, self._along(name, group), self.eps)
                    if wrong is not None:
                        found.append(self._wrong(name, wrong, group))
                        break
        return found

    def _groups(self) -> list[str | None]:
        """Arguments for the differences; None for all of them at once."""
        groups = self.ladder.groups
        return [None, *(groups if len(groups) > 1 else [])]

    def _along(self, name: str, group: str | None) -> dict:
        d = self.along[name]
        if group is None:
            return d
        return {key: x if key == group else jax.tree.map(jnp.zeros_like, x) for key, x in d.items()}

    def _shifted(self, name: str, by: float, d: dict) -> dict:
        def shift(x: Array, d: Array) -> Array:
            return x + jnp.asarray(by, x.dtype) * d

        return jax.tree.map(shift, self.at[name], d)

    def _not_finite(self, name: str, mode: str, order: int, vmapped: bool) -> list[Finding]:
        z, d = self.at[name], self.along[name]
        found = self.ladder.origins(mode, order, z, d, vmapped=vmapped)
        masked = mode != _check.FORWARD and (_check.FORWARD, order) in self.ladder.steps
        hint = _BATCHED if vmapped else _MASKED if masked else ""
        return [
            self._finding(
                name, "not finite", order, names, vmapped, mode, o, hint or HINTS.get(o[0], "")
            )
            for o, names in found
        ]

    def _wrong(self, name: str, wrong: _check.Mismatch, group: str | None) -> Finding:
        rules = list(dict.fromkeys(self.ladder.program.rules))
        of = "" if group is None else f" of {group} alone"
        hint = (
            f"Its {wrong.mode} derivative along a random direction{of} is {wrong.value:.8g}, its "
            f"{wrong.against} {wrong.other:.8g}."
        )
        if len(rules) > 1:
            places = ", ".join(f"{Path(rule.file).name}:{rule.line}" for rule in rules)
            hint += f" It has derivative rules of its own for the functions at {places}."
        origin = rules[0] if len(rules) == 1 else Origin("")
        return self._finding(name, "wrong", wrong.order, "", False, wrong.mode, origin, hint)

    def _finding(
        self,
        state: str,
        kind: str,
        order: int,
        variables: str,
        vmapped: bool,
        mode: str,
        origin: Origin,
        hint: str,
    ) -> Finding:
        z = self.at[state]
        speeds = z["u"] if "u" in self.function.arguments else z["v"]
        place = (origin.primitive, origin.file, origin.line)
        return Finding(
            self.function.name,
            kind,
            order,
            variables,
            state,
            _floats(z["q"]),
            _floats(speeds),
            vmapped,
            mode,
            *place,
            hint,
        )


def _direction(rng: np.random.Generator, z: dict) -> dict:
    """A dense random direction in the units of the arguments: of their size, or 1 for zeros."""

    def along(x: Array) -> Array:
        size = np.where(np.asarray(x) == 0, 1.0, np.abs(x))
        return jnp.asarray(size * _check.dense(rng, x.shape), x.dtype)

    return jax.tree.map(along, z)


def _first(values: Mapping[tuple[str, int], Any]) -> tuple[str, int] | None:
    """(mode, order) of the first nonfinite derivative."""
    for step, value in values.items():
        if not _check.finite(value):
            return step
    return None


def _stack(lanes: list[dict]) -> dict:
    return jax.tree.map(lambda *x: jnp.stack(x), *lanes)


def _lane(batch: Mapping[tuple[str, int], Any], i: int) -> dict[tuple[str, int], Any]:
    return {step: jax.tree.map(lambda x: x[i], value) for step, value in batch.items()}


def _floats(x: Any) -> tuple[float, ...]:
    return tuple(float(y) for y in np.asarray(x))
