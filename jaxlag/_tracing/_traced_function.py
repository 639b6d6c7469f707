"""A user function as a program, traced once for each kind of arguments.

The values of its globals and closures are read at that time. They are used for all results: the
motion, its energy, its derivatives.
"""

import logging
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, replace
from functools import update_wrapper
from inspect import signature, unwrap
from types import CodeType
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary, WeakValueDictionary

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun

from jaxlag._core._arrays import concrete
from jaxlag._core._custom_jvp import with_rules_kept
from jaxlag._core._errors import invalid
from jaxlag._core._max_min import with_sound_extremes
from jaxlag._tracing import _params
from jaxlag._tracing._closure_params import ParamsWithClosure, plain
from jaxlag._tracing._custom_vjp import with_forward_derivatives
from jaxlag._tracing._defining_package import of_library
from jaxlag._tracing._free_variables import outside
from jaxlag._tracing._input_values import InputValues
from jaxlag._tracing._program_constants import copy_constants
from jaxlag._tracing._user_errors import translate
from jaxlag._tracing._watched_values import Outside, changes


class _Program(NamedTuple):
    """A function traced for one kind of arguments.

    Attributes:
        code: from the traced leaves of the arguments to those of the result.
        form: the structure of the result's leaves.
        static: the rest of the result.
        inputs: names of the inputs that were read.
    """

    code: ClosedJaxpr
    form: Any
    static: Any
    inputs: frozenset[str]


class _Traced(NamedTuple):
    """A placeholder for a traced value in a closure, with its identity."""

    id: int


class TracedFunction:
    """A function that is traced once for every kind of arguments, and then not called again.

    It hashes and compares as the function does. There is one object per function as long as it
    exists: systems of one function share the values that it has read.

    Attributes:
        function: as the user wrote it.
    """

    function: Callable

    def __init__(self, function: Callable) -> None:
        self.function = function
        self._programs: dict[Any, _Program] = {}
        self._outside: Outside | None = None
        self._warned: set[str] = set()  # paths of Python ints that were warned about
        update_wrapper(self, function, updated=())  # attributes of an object are not copied

    def __hash__(self) -> int:
        return hash(self.function)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, TracedFunction) and self.function == other.function

    def __reduce__(self) -> Any:
        return traced_function, (self.function,)

    def __call__(self, *arguments: Any, **keywords: Any) -> Any:
        """The result of the function."""
        if keywords:
            arguments = signature(self.function).bind(*arguments, **keywords).args
        closed = [x for x in arguments if isinstance(x, ParamsWithClosure)]
        return self.call_with_closure(closed[0] if closed else None, *arguments)

    def call_with_closure(self, params: Any, *arguments: Any) -> Any:
        """The same; values of traced values in its closure come with the params."""
        named = tuple(i for i, x in enumerate(arguments) if isinstance(x, InputValues))
        given = [x.peek() if isinstance(x, InputValues) else plain(x) for x in arguments]
        traced, rest = _params.halves(given)
        leaves, tree = jax.tree.flatten(traced)
        if len({x.dtype for x in leaves}) == 1:  # Python numbers then need no weak type
            leaves = [jnp.asarray(x, x.dtype) for x in leaves]
        static = _params.Static(rest)
        if not _params.are_keys(rest):  # compiled programs cannot have such params either
            return _called(self.function, [plain(x) for x in arguments])
        kind = (tree, static, tuple(_params.shapes(leaves)), named, jax_settings())
        program = self._programs.get(kind)
        if program is None:
            program = self._closing(params, kind, leaves)
        else:
            self.warn()
        for i in named:
            arguments[i].read |= program.inputs
        found = map(jnp.asarray, jaxpr_as_fun(program.code)(*leaves))
        return eqx.combine(jax.tree.unflatten(program.form, found), program.static)

    def _closing(self, params: Any, kind: Any, leaves: list) -> _Program:
        """A program that is not cached: with values for the traced values in its closure."""
        if not isinstance(params, ParamsWithClosure):
            return self._trace(kind, leaves)
        instead, made = params.by_tracer, params.programs
        if (self, kind) not in made:
            program = self._trace(kind, leaves)
            # Without the tracers, which cached programs would keep alive.
            reads = [_Traced(id(x)) if id(x) in instead else x for x in program.code.consts]
            if not concrete(reads):
                return program
            made[self, kind] = program._replace(code=ClosedJaxpr(program.code.jaxpr, reads))
        program = made[self, kind]
        consts = [instead[x.id] if isinstance(x, _Traced) else x for x in program.code.consts]
        return program._replace(code=ClosedJaxpr(program.code.jaxpr, consts))

    def _trace(self, kind: Any, leaves: list) -> _Program:
        """The program for a new kind of arguments; cached unless its closure has traced values."""
        read = outside(self.function) if self._outside is None else {}
        tree, static, _, named, _ = kind
        program = self._traced(tree, static, leaves, named)
        if not concrete(*program.code.consts):
            return program
        if not self._programs:
            _count(self.function)
        self._warn_of_counts(kind)
        if self._outside is None:
            # Ignore variables that the function itself modifies, such as counters.
            own = {name for name, _, _ in changes(read)}
            self._outside = {name: x for name, x in read.items() if name not in own}
        return self._programs.setdefault(kind, program)

    def _traced(
        self, tree: Any, static: _params.Static, leaves: list, named: tuple[int, ...]
    ) -> _Program:
        form = static_part = None
        read: set[str] = set()

        def flat(*leaves: Any) -> list[Any]:
            arguments = list(_params.join(jax.tree.unflatten(tree, leaves), static.tree))
            for i in named:
                arguments[i] = InputValues(arguments[i])
            value = _called(self.function, arguments)
            for i in named:
                read.update(arguments[i].read)
            dynamic, rest = eqx.partition(value, _params.is_array)
            nonlocal form, static_part
            static_part = rest
            found, form = jax.tree.flatten(dynamic)
            return found

        code = jax.make_jaxpr(flat)(*_params.shapes(leaves))
        code = with_rules_kept(with_forward_derivatives(copy_constants(code)))
        code = with_sound_extremes(code)
        return _Program(code, form, static_part, frozenset(read))

    def _warn_of_counts(self, kind: Any) -> None:
        """Warn of Python ints that are used as numbers: each value recompiles.

        The warning is given at the third value of the same leaf.
        """
        tree, static, *rest = kind
        given, _ = jax.tree_util.tree_flatten_with_path(static.tree)
        others = [
            jax.tree.leaves(other.tree)
            for form, other, *more in self._programs
            if form == tree and other.treedef == static.treedef and more == rest
        ]
        for i, (path, leaf) in enumerate(given):
            if type(leaf) is not int:
                continue
            values = {leaf, *(leaves[i] for leaves in others if type(leaves[i]) is int)}
            name = _leaf(path)
            if len(values) < MANY_VALUES or name in self._warned:
                continue
            self._warned.add(name)
            warnings.warn(
                f"{name} of {_named(self.function)} is the Python int {leaf}, its "
                f"{len(values)}th value so far: an int is part of the program, which is compiled "
                f"again for each value. Write {float(leaf)} if it is a physical parameter.",
                UserWarning,
                stacklevel=1,
            )

    @property
    def known(self) -> bool:
        """Whether it has been traced, without traced values in its closure."""
        return bool(self._programs)

    def warn(self) -> None:
        """Warn of outside values that have changed since the function read them."""
        for name, before, now in changes(self._outside or {}):
            message = (
                f"{name}, which {_named(self.function)} reads from outside, was {before} at the "
                f"first trace and is {now} now. The function still uses the old value. Pass it in "
                "params, or define the function again."
            )
            warnings.warn(message, UserWarning, stacklevel=1)


MANY_VALUES = 3  # values of one int among the params from which on it looks like a number
MANY_FUNCTIONS = 20  # functions from one piece of code from which on it looks like a loop
_logger = logging.getLogger("jaxlag")
# Not settings: number of functions from each piece of code; the object of each function as long as
# it is referenced.
_MADE: WeakKeyDictionary[CodeType, int] = WeakKeyDictionary()
_ALIVE: WeakValueDictionary[Callable, TracedFunction] = WeakValueDictionary()


def _leaf(path: Any) -> str:
    """A leaf of the params, by its path in the arguments of a function."""
    return f"params{jax.tree_util.keystr(path[1:])}"


def _count(function: Callable) -> None:
    """Log once if a function is made again and again, such as a lambda in a loop."""
    code = getattr(unwrap(function), "__code__", None)
    if code is None:
        return
    _MADE[code] = _MADE.get(code, 0) + 1
    if _MADE[code] == MANY_FUNCTIONS:
        _logger.warning(
            "%s (line %d of %s) was traced as a new function for the %dth time: systems made of "
            "new functions are compiled again. Define it once, outside of loops, and pass in "
            "params what changes.",
            *(_named(function), code.co_firstlineno, code.co_filename, MANY_FUNCTIONS),
        )


def _called(function: Callable, arguments: list[Any]) -> Any:
    """Call the function; errors in it are raised in our form if that helps."""
    try:
        return function(*arguments)
    except Exception as error:
        better = translate(function, arguments, error)
        if better is None:
            raise
        raise better from error


def traced_function(function: Callable) -> TracedFunction:
    """The `TracedFunction` of a function; the same object for the same function.

    Raises:
        ValueError: it does not hash, such as modules with arrays.
    """
    if isinstance(function, TracedFunction):
        return function
    try:
        hash(function)
    except TypeError as error:
        module = getattr(function, "__self__", function)
        raise invalid(
            f"function {_named(function)}",
            "be hashable, since compiled programs are stored by function",
            f"the {type(module).__name__} that it belongs to holds arrays",
            "Put the module into params and call it from a function: "
            'def lagrangian(t, q, v, params): return params["model"](t, q, v).',
        ) from error
    return _ALIVE.setdefault(function, TracedFunction(function))


def traced_unless_module(function: Any) -> Any:
    """The same for a plain function; a module is unchanged, as its arrays are traced.

    Raises:
        ValueError: a module whose static fields are mutable.
    """
    if not isinstance(function, eqx.Module):
        return traced_function(function)
    if not of_library(function):  # library modules check their own parts
        _params.check_keys(function, type(function).__name__)
    return function


def as_written(function: Any) -> Any:
    """The user's function itself, which receives numbers for numbers."""
    if isinstance(function, TracedFunction):
        return function.function
    if not isinstance(function, eqx.Module):
        return function
    parts = {f.name: as_written(getattr(function, f.name)) for f in fields(function)}
    return replace(function, **parts)


def functions_of(declared: Any) -> Iterator[TracedFunction]:
    """All the functions in a declaration, or in inputs."""
    return (part for part in _parts_of(declared) if isinstance(part, TracedFunction))


def warn_of_changes(*declared: Any) -> None:
    """Warn of outside values read by declarations or inputs that have changed."""
    for part in _parts_of(declared):
        if isinstance(part, TracedFunction):
            part.warn()
        elif not of_library(part):
            _params.check_keys(part, type(part).__name__)


def _parts_of(declared: Any) -> list[Any]:
    """The functions and the modules."""
    if isinstance(declared, TracedFunction):
        return [declared]
    if declared is None or isinstance(declared, str | bool):  # most fields: an ABC's test is slow
        return []
    if isinstance(declared, eqx.Module):
        return [declared, *(x for part in vars(declared).values() for x in _parts_of(part))]
    if isinstance(declared, tuple):
        return [x for part in declared for x in _parts_of(part)]
    if isinstance(declared, Mapping):
        return [x for part in declared.values() for x in _parts_of(part)]
    return []


def jax_settings() -> tuple:
    """The JAX settings that affect tracing."""
    config: Any = jax.config
    return (
        config.jax_enable_x64,
        config.jax_numpy_dtype_promotion,
        config.jax_default_matmul_precision,
    )


def _named(function: Callable) -> str:
    return repr(getattr(function, "__qualname__", function))
