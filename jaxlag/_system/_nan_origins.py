"""Origins of nonfinite numbers in a program and in its derivatives.

A derivative is a separate program, whose equations have the names of other operations: the
derivative of sqrt(x) divides by 2 sqrt(x). So the equations of a traced function are labeled before
it is differentiated. JAX passes each label on to all equations derived from it.
"""

import re
from collections.abc import Callable
from inspect import getfile
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jaxtyping
import numpy as np
from jax._src import source_info_util
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, jaxpr_as_fun

from jaxlag._core._jaxprs import called, scan_sizes, within
from jaxlag._tracing._interpret import equation

_LABEL = re.compile(r"jaxlag equation (\d+)\.")
_NOT_THE_USERS = (
    str(Path(__file__).parents[1]),
    *(str(Path(getfile(package)).parent) for package in (eqx, jaxtyping)),
)
_LONG = 64  # longer loops are not run equation by equation, unless they have to be searched
_RULES = {"custom_jvp_call", "custom_vjp_call", "custom_vjp_call_jaxpr"}


class Origin(NamedTuple):
    """An operation of the user's program.

    Attributes:
        primitive: its name in JAX, as in a jaxpr.
        file: file of the user's code with the operation; "" if unknown.
        line: line of the file, from 1; 0 if unknown.
    """

    primitive: str
    file: str = ""
    line: int = 0


class TracedProgram:
    """A function traced once; it can be called and differentiated, and finds origins of NaN.

    Args:
        function: of one pytree of arrays, returning an array.
        example: the pytree; only shapes and dtypes are used.
    """

    def __init__(self, function: Callable, example: Any) -> None:
        closed = jax.make_jaxpr(function)(example)
        self.operations: list[Origin] = []
        self.rules: list[Origin] = []
        self.closed = closed.replace(jaxpr=self._labeled(closed.jaxpr, ("", 0)))

    def __call__(self, z: Any) -> Any:
        return jaxpr_as_fun(self.closed)(*jax.tree.leaves(z))[0]

    def contains(self, *primitives: str) -> bool:
        """Whether it contains one of these operations, also in nested programs."""
        return any(operation.primitive in primitives for operation in self.operations)

    def origins(self, derivative: ClosedJaxpr, *args: Any) -> list[Origin]:
        """Operations of this program at which a derivative becomes nonfinite, in order.

        Only those that reach the results: values that a `where` excludes are ignored. The
        primitive is "" for an operation without counterpart in this program.
        """
        with np.errstate(all="ignore"):
            known = _run(derivative, [np.asarray(x) for x in jax.tree.leaves(args)])
            wanted = [_bad(_value(known, atom)) for atom in derivative.jaxpr.outvars]
            births, _ = _back(derivative, known, wanted)
        return list(dict.fromkeys(self._origin(eqn) for eqn in births))

    def _origin(self, eqn: Any) -> Origin:
        labels = _LABEL.findall(str(eqn.source_info.name_stack))
        return self.operations[int(labels[-1])] if labels else Origin("")

    def _labeled(self, jaxpr: Jaxpr, outer: tuple[str, int]) -> Jaxpr:
        """The program with a label on every equation; `outer` is the line of its call."""
        eqns = []
        for eqn in jaxpr.eqns:
            name, info = eqn.primitive.name, eqn.source_info
            place = _line(info.traceback) or outer
            label = f"jaxlag equation {len(self.operations)}."
            self.operations.append(Origin(name, *place))
            if name in _RULES:
                self.rules += _rule(eqn)
            params = {key: self._inside(value, place) for key, value in eqn.params.items()}
            info = info.replace(name_stack=info.name_stack.extend(label))
            eqns.append(eqn.replace(params=params, source_info=info))
        return jaxpr.replace(eqns=eqns)

    def _inside(self, value: Any, outer: tuple[str, int]) -> Any:
        if isinstance(value, ClosedJaxpr):
            return value.replace(jaxpr=self._labeled(value.jaxpr, outer))
        if isinstance(value, Jaxpr):
            return self._labeled(value, outer)
        if type(value) in (tuple, list):
            return type(value)(self._inside(item, outer) for item in value)
        return value


def _line(traceback: Any) -> tuple[str, int] | None:
    """The innermost line of the user's code; lines of JAX and of jaxlag are skipped.

    Callers are not among the frames: those of a traced function begin where its tracing begins.
    """
    for frame in source_info_util.user_frames(traceback):
        if _is_users(frame.file_name):
            return frame.file_name, frame.start_line
    return None


def _is_users(file: str) -> bool:
    return not file.startswith((*_NOT_THE_USERS, "<@beartype")) and "/beartype/" not in file


def _rule(eqn: Any) -> list[Origin]:
    """The function that has a custom rule of the user."""
    info = eqn.params["call_jaxpr"].jaxpr.debug_info
    found = re.fullmatch(r".* at (.*):(\d+)", info.func_src_info or "")
    if not found or not _is_users(found[1]) or not source_info_util.is_user_filename(found[1]):
        return []
    return [Origin(eqn.primitive.name, found[1], int(found[2]))]


# ---- A program run forwards, then traced backwards --------------------------------------------


def evaluate(closed: ClosedJaxpr, *args: Any) -> list[np.ndarray]:
    """The results of a program at given arrays, equation by equation, without compilation.

    Unlike `interpret` it runs choices and short loops itself.
    """
    with np.errstate(all="ignore"):
        return _results(closed, [np.asarray(x) for x in args])


def _value(known: dict, atom: Any) -> np.ndarray:
    return np.asarray(atom.val if isinstance(atom, Literal) else known[atom])


def _run(closed: ClosedJaxpr, args: list) -> dict:
    """Every variable of a program -> its value."""
    jaxpr = closed.jaxpr
    known = dict(zip(jaxpr.constvars, map(np.asarray, closed.consts), strict=True))
    known.update(zip(jaxpr.invars, args, strict=True))
    for eqn in jaxpr.eqns:
        operands = [np.asarray(a.val) if isinstance(a, Literal) else known[a] for a in eqn.invars]
        long = eqn.params.get("length", 0) > _LONG  # JAX compiles it
        plain = long or next(within(eqn), None) is None
        nested = None if plain else _nested(eqn, operands)
        results = equation(eqn, operands) if nested is None else nested.results
        known.update(zip(eqn.outvars, results, strict=True))
    return known


def _back(closed: ClosedJaxpr, known: dict, wanted: list) -> tuple[list, list]:
    """Equations, in order, at which the wanted entries of the results become nonfinite.

    Args:
        closed: the program.
        known: the result of `_run` for it.
        wanted: for every result a mask of the examined entries, none of them finite.

    Returns:
        Those equations, and for every input a mask of its nonfinite entries that reach the results.
    """
    asked: dict[Any, np.ndarray] = {}

    def ask(atoms: list, masks: list) -> None:
        for atom, mask in zip(atoms, masks, strict=True):
            if not isinstance(atom, Literal) and mask.any():
                asked[atom] = asked[atom] | mask if atom in asked else mask

    def answer(atoms: list) -> list:
        return [asked.get(a, np.zeros(np.shape(known[a]), bool)) for a in atoms]

    births: list = []
    ask(closed.jaxpr.outvars, wanted)
    for eqn in reversed(closed.jaxpr.eqns):
        masks = answer(eqn.outvars)
        if not any(mask.any() for mask in masks):
            continue
        operands = [_value(known, atom) for atom in eqn.invars]
        nested = _nested(eqn, operands)
        if nested is None:
            sources = _sources(eqn, operands, masks)
            inside = [] if any(mask.any() for mask in sources) else [eqn]
        else:
            inside, sources = nested.back(masks)
        births = inside + births
        ask(eqn.invars, sources)
    return births, answer(closed.jaxpr.invars)


def _bad(x: np.ndarray) -> np.ndarray:
    inexact = np.issubdtype(x.dtype, np.inexact)
    return np.asarray(~np.isfinite(x)) if inexact else np.zeros(x.shape, bool)


# Elementwise: a nonfinite result does not depend on other entries of the operands.
_ENTRYWISE = frozenset(
    """abs acos acosh add add_any asin asinh atan atan2 atanh cbrt clamp convert_element_type copy
    copy_p cos cosh div erf exp exp2 expm1 integer_pow log log1p logistic max min mul neg pow
    reduce_precision rsqrt sign sin sinh sqrt square stop_gradient sub tan tanh""".split()  # noqa: SIM905
)


def _sources(eqn: Any, operands: list, masks: list) -> list:
    """For every operand a mask of the nonfinite entries that reach the wanted results.

    Literals of the program count as finite: the origin is the operation that uses them.
    """
    stated = [isinstance(atom, Literal) for atom in eqn.invars]
    bad = [_bad(x) & (not s) for x, s in zip(operands, stated, strict=True)]
    if eqn.primitive.name == "select_n":
        which = operands[0].astype(int)
        chosen = [masks[0] & (which == k) for k in range(len(operands) - 1)]
        return [bad[0], *(x & mask for x, mask in zip(bad[1:], chosen, strict=True))]
    if eqn.primitive.name in _ENTRYWISE:
        return [x & masks[0] if x.shape == masks[0].shape else x for x in bad]
    return bad


# ---- Programs within programs -----------------------------------------------------------------


class _Call(NamedTuple):
    """An equation that runs one program on its operands, except the first `offset` of them."""

    body: ClosedJaxpr
    operands: list[np.ndarray]
    offset: int

    @property
    def results(self) -> list[np.ndarray]:
        """Results of the equation."""
        return _results(self.body, self.operands[self.offset :])

    def back(self, masks: list) -> tuple[list, list]:
        """As `_back`, for the operands of the equation."""
        births, found = _back(self.body, _run(self.body, self.operands[self.offset :]), masks)
        return births, [*_nothing(self.operands[: self.offset]), *found]


class _Loop(NamedTuple):
    """An equation that runs a program repeatedly, each time on the results of the last one.

    Attributes:
        body: the program of one iteration.
        operands: operands of the equation: `offset` that the body does not take, `fixed` that all
            iterations share, `carried` from one iteration to the next, and one row of the rest for
            each iteration.
        iterations: (row, arguments of the body) in the order of execution.
        results: results of the equation: the carried values at the end, and the rows of all
            iterations.
    """

    body: ClosedJaxpr
    operands: list[np.ndarray]
    offset: int
    fixed: int
    carried: int
    iterations: list[tuple[int, list]]
    results: list[np.ndarray]

    def back(self, masks: list) -> tuple[list, list]:
        """As `_back`, for the operands of the equation."""
        births: list = []
        sources = _nothing(self.operands)
        first = self.offset + self.fixed
        carry, stacked = masks[: self.carried], masks[self.carried :]
        for row, args in reversed(self.iterations):
            wanted = [*carry, *(mask[row] for mask in stacked)]
            inside, found = _back(self.body, _run(self.body, args), wanted)
            births = inside + births
            carry = found[self.fixed : self.fixed + self.carried]
            for k, mask in enumerate(found[: self.fixed]):
                sources[self.offset + k] |= mask
            for k, mask in enumerate(found[self.fixed + self.carried :]):
                sources[first + self.carried + k][row] |= mask
        sources[first : first + self.carried] = carry
        return births, sources


def _results(closed: ClosedJaxpr, args: list) -> list[np.ndarray]:
    known = _run(closed, args)
    return [_value(known, atom) for atom in closed.jaxpr.outvars]


def _nothing(operands: list) -> list[np.ndarray]:
    return [np.zeros(np.shape(x), bool) for x in operands]


def _nested(eqn: Any, operands: list) -> _Call | _Loop | None:
    """An equation with its nested programs, for the chosen branch; None if it has none."""
    name, params = eqn.primitive.name, eqn.params
    if name == "cond":
        branches = params["branches"]
        return _Call(branches[np.clip(int(operands[0]), 0, len(branches) - 1)], operands, 1)
    if name == "scan":
        return _scan(eqn, operands)
    if name == "while":
        return _while(params, operands)
    inner = called(eqn)
    return None if inner is None else _Call(inner, operands, 0)


def _scan(eqn: Any, operands: list) -> _Loop:
    body, length = eqn.params["jaxpr"], eqn.params["length"]
    fixed, carried = scan_sizes(eqn.params)
    consts, carry = operands[:fixed], operands[fixed : fixed + carried]
    rows = operands[fixed + carried :]
    made = [np.zeros(v.aval.shape, v.aval.dtype) for v in eqn.outvars[carried:]]
    iterations = []
    for row in reversed(range(length)) if eqn.params["reverse"] else range(length):
        args = [*consts, *carry, *(x[row] for x in rows)]
        iterations.append((row, args))
        outs = _results(body, args)
        carry = outs[:carried]
        for x, out in zip(made, outs[carried:], strict=True):
            x[row] = out
    return _Loop(body, operands, 0, fixed, carried, iterations, [*carry, *made])


def _while(params: Any, operands: list) -> _Loop:
    offset, fixed = params["cond_nconsts"], params["body_nconsts"]
    asked, consts = operands[:offset], operands[offset : offset + fixed]
    carry, iterations = operands[offset + fixed :], []
    while bool(_results(params["cond_jaxpr"], [*asked, *carry])[0]):
        args = [*consts, *carry]
        iterations.append((0, args))
        carry = _results(params["body_jaxpr"], args)
    return _Loop(params["body_jaxpr"], operands, offset, fixed, len(carry), iterations, carry)
