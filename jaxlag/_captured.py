"""A function of the user's as a program: traced once for each kind of arguments.

What it reads from globals and closures is read then, and holds for everything that is ever computed
of it: the motion, its energy, its derivatives.
"""

import warnings
from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from functools import update_wrapper
from inspect import signature
from typing import Any, NamedTuple
from weakref import WeakValueDictionary

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, jaxpr_as_fun

from jaxlag import _params
from jaxlag._input_values import InputValues
from jaxlag._outside import Outside, changes, outside


class _Program(NamedTuple):
    """A function traced for one kind of arguments.

    Attributes:
        code: from the traced leaves of the arguments to those of the result.
        form: the structure of the latter.
        static: the rest of the result.
        inputs: names of the inputs that were read.
    """

    code: ClosedJaxpr
    form: Any
    static: Any
    inputs: frozenset[str]


@jax.tree_util.register_pytree_node_class
class Closed:
    """Params, and beside them the traced values that the declaration closes over.

    In this way they are arguments of every program, as params are, and have derivatives.

    Attributes:
        params: as the user gave them.
        values: what stands for the tracers in the functions' closures.
        tracers: which is for which, by their identity.
    """

    def __init__(self, params: Any, values: Any, tracers: tuple[int, ...]) -> None:
        self.params, self.values, self.tracers = params, values, tracers

    def tree_flatten(self) -> tuple[tuple[Any, Any], tuple[int, ...]]:
        """As JAX asks for it."""
        return (self.params, self.values), self.tracers

    @classmethod
    def tree_unflatten(cls, tracers: tuple[int, ...], parts: Any) -> "Closed":
        """As JAX asks for it."""
        params, values = parts
        return cls(params, values, tracers)


def plain(params: Any) -> Any:
    """Params as the user gave them."""
    return params.params if isinstance(params, Closed) else params


class Captured:
    """A function that is traced once for every kind of arguments, and never called again.

    It hashes and compares as the function does, and is one object as long as it lives: systems made
    of one function share what it read.

    Attributes:
        function: as the user wrote it.
    """

    function: Callable

    def __init__(self, function: Callable) -> None:
        self.function = function
        self._programs: dict[Any, _Program] = {}
        self._outside: Outside | None = None
        update_wrapper(self, function)

    def __hash__(self) -> int:
        return hash(self.function)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Captured) and self.function == other.function

    def __reduce__(self) -> Any:
        return captured, (self.function,)

    def __call__(self, *arguments: Any, **keywords: Any) -> Any:
        """What the function returns."""
        if keywords:
            arguments = signature(self.function).bind(*arguments, **keywords).args
        named = {i: x for i, x in enumerate(arguments) if isinstance(x, InputValues)}
        given = {}
        for x in arguments:
            given |= dict(zip(x.tracers, x.values, strict=True)) if isinstance(x, Closed) else {}
        arguments = tuple(x.peek() if isinstance(x, InputValues) else plain(x) for x in arguments)
        traced, rest = _params.split(arguments)
        leaves, tree = jax.tree.flatten(traced)
        if len({x.dtype for x in leaves}) == 1:  # numbers of Python's have nothing to give way to
            leaves = [jnp.asarray(x, x.dtype) for x in leaves]
        static = _params.Static(rest)
        kind = (tree, static, tuple(_params.shapes(leaves)), tuple(named), _config())
        program = self._programs.get(kind)
        if program is None:
            program = self._traced(tree, static, leaves, tuple(named))
            if _params.concrete(*program.code.consts):
                program = self._programs.setdefault(kind, program)
        else:
            self.warn()
        for values in named.values():
            values.read |= program.inputs
        code = program.code
        if given:
            code = ClosedJaxpr(code.jaxpr, [given.get(id(x), x) for x in code.consts])
        found = map(jnp.asarray, jaxpr_as_fun(code)(*leaves))
        return eqx.combine(jax.tree.unflatten(program.form, found), program.static)

    def _traced(
        self, tree: Any, static: _params.Static, leaves: list, named: tuple[int, ...]
    ) -> _Program:
        form = static_part = None
        read: set[str] = set()

        def flat(*leaves: Any) -> list[Any]:
            arguments = list(_params.join(jax.tree.unflatten(tree, leaves), static.tree))
            for i in named:
                arguments[i] = InputValues(arguments[i])
            value = self.function(*arguments)
            for i in named:
                read.update(arguments[i].read)
            dynamic, rest = eqx.partition(value, _params.is_array)
            nonlocal form, static_part
            static_part = rest
            found, form = jax.tree.flatten(dynamic)
            return found

        before = outside(self.function)
        code = jax.make_jaxpr(flat)(*_params.shapes(leaves))
        if self._outside is None:
            # What the function changes itself is no business of its results: counters, records.
            own = {name for name, _, _ in changes(before)}
            self._outside = {name: read for name, read in before.items() if name not in own}
        return _Program(_own(code), form, static_part, frozenset(read))

    @property
    def known(self) -> bool:
        """Whether it has been traced, and closes over no traced value."""
        return bool(self._programs)

    def warn(self) -> None:
        """Say what the function reads from outside and is not any more what it read."""
        for name, before, now in changes(self._outside or {}):
            message = (
                f"{name}, which {_named(self.function)} reads from outside, was {before} when it "
                f"was first traced, which still holds, and is {now} now. Hand it over in params, "
                "or define the function anew."
            )
            warnings.warn(message, UserWarning, stacklevel=1)


_ALIVE: WeakValueDictionary[Callable, Captured] = WeakValueDictionary()


def captured(function: Callable) -> Captured:
    """The function as one that is traced once; the same object for the same function."""
    if isinstance(function, Captured):
        return function
    try:
        return _ALIVE.setdefault(function, Captured(function))
    except TypeError:  # it has no hash
        return Captured(function)


def as_written(function: Any) -> Any:
    """The function of the user's itself, which sees numbers where it is given numbers."""
    if isinstance(function, Captured):
        return function.function
    if not isinstance(function, eqx.Module):
        return function
    parts = {f.name: as_written(getattr(function, f.name)) for f in fields(function)}
    return replace(function, **parts)


def functions_of(declared: Any) -> Iterator[Captured]:
    """All the functions in a declaration."""
    if isinstance(declared, Captured):
        yield declared
    elif isinstance(declared, tuple):
        for part in declared:
            yield from functions_of(part)
    elif isinstance(declared, eqx.Module):
        for part in vars(declared).values():
            yield from functions_of(part)


def _own(code: ClosedJaxpr) -> ClosedJaxpr:
    """The same program, with its own copy of every constant: those of numpy can be changed."""
    consts = [x if not _params.concrete(x) else _copied(x) for x in code.consts]
    return ClosedJaxpr(_own_inside(code.jaxpr), consts)


def _own_inside(jaxpr: Any) -> Any:
    eqns = []
    for eqn in jaxpr.eqns:
        inner = {key: _own_param(value) for key, value in eqn.params.items()}
        atoms = list(map(_own_atom, eqn.invars))
        eqns.append(eqn.replace(invars=atoms, params=inner))
    return jaxpr.replace(eqns=eqns)


def _own_atom(atom: Any) -> Any:
    if not isinstance(atom, Literal) or not isinstance(atom.val, np.ndarray):
        return atom
    return Literal(atom.val.copy(), atom.aval)


def _own_param(value: Any) -> Any:
    if isinstance(value, ClosedJaxpr):
        return _own(value)
    if isinstance(value, Jaxpr):
        return _own_inside(value)
    if isinstance(value, tuple) and any(isinstance(x, ClosedJaxpr) for x in value):
        inner = map(_own_param, value)
        return tuple(inner) if type(value) is tuple else type(value)(*inner)
    return value


def _copied(x: Any) -> Any:
    if isinstance(x, np.ndarray):
        return x.copy()
    if isinstance(x, jax.Array) and not jnp.issubdtype(x.dtype, jax.dtypes.extended):
        with jax.ensure_compile_time_eval():
            return jnp.array(x, copy=True)  # it may be a view of an array of numpy's
    return x


def _config() -> tuple:
    """What else tracing depends on."""
    config: Any = jax.config
    return (
        config.jax_enable_x64,
        config.jax_numpy_dtype_promotion,
        config.jax_default_matmul_precision,
    )


def _named(function: Callable) -> str:
    return repr(getattr(function, "__qualname__", function))
