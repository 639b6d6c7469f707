"""The cases of a sweep: drawn at random, or entries of arrays."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from inspect import signature
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun
from jax.tree_util import keystr

from jaxlag._core._arguments import positive_integer
from jaxlag._core._arrays import array_of
from jaxlag._core._errors import invalid
from jaxlag._core._jaxprs import equations
from jaxlag._sweep._case import Case
from jaxlag._sweep._digest import digest_of, digest_of_program, without_addresses
from jaxlag._system._system import System
from jaxlag._tracing._params import Static, arrays_apart, check_keys, halves, join

_UNTRACEABLE = (
    jax.errors.ConcretizationTypeError,
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
    jax.errors.NonConcreteBooleanIndexError,
)
_STARTS = ("q0", "v0", "u0", "x0")


class AbstractCases(ABC):
    """Cases by index. Equal ones have the same compiled program, whatever their numbers.

    Attributes:
        static: what of a case is not traced.
    """

    static: Static

    @property
    @abstractmethod
    def form(self) -> "AbstractCases":
        """The same without numbers, for the key of a compiled program."""

    @property
    @abstractmethod
    def digests(self) -> dict[str, str]:
        """Digests of all that the cases depend on, by name."""

    @abstractmethod
    def arguments(self, indices: np.ndarray) -> tuple[Any, Any]:
        """Arrays from which `case` makes these: (those shared by all, entries for each)."""

    @abstractmethod
    def case(self, shared: Any, own: Any) -> Case:
        """One case, traced."""


def cases_of(system: System, given: Any, n: Any, seed: int) -> tuple[AbstractCases, int]:
    """(the cases, their number); raises with the argument's name if they are none."""
    if isinstance(given, Case):
        return _stacked(system, given, n)
    if not callable(given) or isinstance(given, type):
        must, was = "be a function of (key, index), or a jl.Case of arrays", f"it was {given!r}"
        raise invalid("cases", must, was)
    count = positive_integer("n", n)
    return _drawn(given, seed), count


def _starts(case: Case) -> dict[str, Any]:
    """Starts of a case as floating-point numbers: arrays, or arrays by name."""

    def numbers(name: str, x: Any) -> Any:
        if x is None:
            return None
        if isinstance(x, Mapping):
            return {key: numbers(f"{name}[{key!r}]", value) for key, value in x.items()}
        try:
            x = np.asarray(x, float) if isinstance(x, np.ndarray) else array_of(x)
        except (TypeError, ValueError) as error:
            raise invalid(f"cases: {name}", "be numbers", f"it was {x!r}") from error
        return x.astype(jnp.result_type(float)) if jnp.issubdtype(x.dtype, jnp.integer) else x

    return {name: numbers(name, getattr(case, name)) for name in _STARTS}


def _times(ts: Any, ranks: tuple[int, ...]) -> Any:
    """Times of a case as an array."""
    try:
        ts = jnp.asarray(ts, jnp.result_type(float))
    except (TypeError, ValueError) as error:
        raise invalid("cases: ts", "be numbers", f"it was {ts!r}") from error
    if ts.ndim not in ranks or ts.shape[-1] < 2:
        raise invalid("cases: ts", "be at least 2 times", f"its shape was {ts.shape}")
    return ts


# ---- Drawn ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Drawn(AbstractCases):
    """Cases that are a function of (key, index), with a key for each index.

    The function is traced once: what it reads from outside is part of the program.

    Attributes:
        digest: of the program and its constants; equal programs have equal ones.
        static: what of a case is no array.
        tree: structure of its arrays.
        program: (key, index) -> its arrays.
        seed: of the keys.
    """

    digest: str
    static: Static
    tree: Any
    program: ClosedJaxpr = field(compare=False, repr=False)
    seed: int = field(compare=False)

    @property
    def form(self) -> AbstractCases:
        """The same, with another seed."""
        return replace(self, seed=0)

    @property
    def digests(self) -> dict[str, str]:
        """Of the function, and the seed."""
        return {"cases": self.digest, "seed": str(self.seed)}

    def arguments(self, indices: np.ndarray) -> tuple[Any, Any]:
        """(the key of the sweep, indices)."""
        return jax.random.key(self.seed), indices.astype(jax.dtypes.canonicalize_dtype(int))

    def case(self, shared: Any, own: Any) -> Case:
        """That of one index."""
        leaves = jaxpr_as_fun(self.program)(jax.random.fold_in(shared, own), own)
        return eqx.combine(jax.tree.unflatten(self.tree, leaves), self.static.tree)


def _drawn(draw: Callable, seed: int) -> Drawn:
    """Cases from a function that returns one, the same for the same arguments.

    Raises:
        ValueError: it takes other arguments, returns something else, needs values, calls back to
            Python, or reads what changes.
    """
    try:
        signature(draw).bind(None, None)
    except TypeError as error:
        was = f"it was called {getattr(draw, '__name__', draw)!r}: {error}"
        raise invalid("cases", "take (key, index)", was) from error
    try:
        (found, plain), (again, others) = _traced(draw, seed), _traced(draw, seed)
    except _UNTRACEABLE as error:
        was = f"it needed a value: {str(error).splitlines()[0].rstrip('.')}"
        fix = "Write jnp.where for choices by value, and jax.numpy for numpy."
        raise invalid("cases", "be traceable by JAX", was, fix) from error
    if (found.digest, found.tree, plain) != (again.digest, again.tree, others):
        must, was = "depend on key and index alone", "two calls gave different programs"
        fix = "Draw by jax.random with `key`, not by numpy or from a state that changes."
        raise invalid("cases", must, was, fix)
    return found


def _traced(draw: Callable, seed: int) -> tuple[Drawn, list[Any]]:
    """(cases, what of their static part is no function)."""
    parts: list[Any] = []

    def arrays(key: Any, index: Any) -> list[Any]:
        case = draw(key, index)
        if not isinstance(case, Case):
            raise invalid("cases", "return a jl.Case", f"it returned a {type(case).__name__}")
        ts = None if case.ts is None else _times(case.ts, (1,))
        case = replace(case, **_starts(case), ts=ts)
        check_keys(case, "cases")
        traced, static = arrays_apart(case)
        parts[:] = jax.tree.structure(traced), Static(static)
        return jax.tree.leaves(traced)

    index = np.zeros((), jax.dtypes.canonicalize_dtype(int))
    program = jax.make_jaxpr(arrays)(jax.random.key(0), index)
    calls = [eqn.primitive.name for eqn in equations(program) if "callback" in eqn.primitive.name]
    if calls:
        must, was = "be computed by JAX alone", f"it calls back to Python by {calls[0]}"
        raise invalid("cases", must, was)
    tree, static = parts
    plain = [x for x in jax.tree.leaves(static.tree) if not callable(x)]
    return Drawn(digest_of_program(program), static, tree, program, seed), plain


# ---- Stacked -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Stacked(AbstractCases):
    """Cases that are entries of arrays.

    Attributes:
        static: what of a case is not traced.
        own: a case of arrays with a leading axis.
        shared: a case of the other arrays.
    """

    static: Static
    own: Case | None = field(compare=False)
    shared: Case | None = field(compare=False)

    @property
    def form(self) -> AbstractCases:
        """The same without arrays."""
        return replace(self, own=None, shared=None)

    @property
    def digests(self) -> dict[str, str]:
        """Of each part."""
        case = self.case(self.shared, self.own)
        parts = {f"cases.{x.name}": getattr(case, x.name) for x in fields(Case)}
        return {name: digest_of(_structure(x), x) for name, x in parts.items()}

    def arguments(self, indices: np.ndarray) -> tuple[Any, Any]:
        """(arrays shared by all, entries)."""
        return self.shared, jax.tree.map(lambda x: x[indices], self.own)

    def case(self, shared: Any, own: Any) -> Case:
        """That of these entries."""
        return eqx.combine(join(own, self.static.tree), shared)


def _structure(tree: Any) -> str:
    return without_addresses(str(jax.tree.structure(tree)))


def _stacked(system: System, case: Case, n: Any) -> tuple[Stacked, int]:
    """Cases by entries of arrays."""
    case = _with_arrays(system, case)
    check_keys(case, "cases")
    lengths: dict[str, int] = {}

    def divided(path: Any, x: Any) -> tuple[Any, Any, Any]:
        """(what is not traced, an array with a leading axis, a shared array)."""
        name = f"cases{keystr(path)}"
        is_own = np.ndim(x) > _rank_of_one(system, path, x)
        if is_own:
            lengths[name] = x.shape[0]
        if is_own and _is_repeated(x):
            x = x[0]
        elif is_own:
            if x.dtype == bool:
                must, was = "be numbers where trajectories differ", "it was an array of bool"
                raise invalid(name, must, was, "Write x.astype(float).")
            return None, _indexable(x), None
        traced, static = halves(x)
        return static, None, traced

    paths, tree = jax.tree_util.tree_flatten_with_path(case)
    leaves = [divided(path, x) for path, x in paths]
    count = _number_of(n, lengths)
    static, own, shared = (tree.unflatten([leaf[i] for leaf in leaves]) for i in range(3))
    return Stacked(Static(static), own, shared), count


def _with_arrays(system: System, case: Case) -> Case:
    """The same with starts and times as arrays of shapes that are allowed."""
    layouts = {"q0": system.coordinates, "v0": system.coordinates}
    if system.states is not None:
        layouts["x0"] = system.states.layout
    given = _starts(case)
    for name, layout in layouts.items():
        x = given[name]
        if x is None or isinstance(x, Mapping):
            continue
        shape, size = x.shape, layout.size
        alone = size == 1 and x.ndim <= 1  # a number stands for one of one entry
        if not alone and (x.ndim not in (1, 2) or shape[-1] != size):
            must = f"have shape ({size},) or (n, {size})"
            raise invalid(f"cases: {name}", must, f"its shape was {shape}")
    if case.ts is not None:
        given["ts"] = ts = np.asarray(_times(case.ts, (1, 2)))
        steps = np.diff(ts)
        if not (np.all(steps > 0, -1) | np.all(steps < 0, -1)).all():
            raise invalid("cases: ts", "be strictly monotone for every trajectory", "it was not")
    return replace(case, **given)


def _rank_of_one(system: System, path: Any, x: Any) -> int:
    """Number of axes of a leaf in one case; of params and inputs those without axes are shared."""
    name, *keys = (getattr(key, "name", getattr(key, "key", None)) for key in path)
    if name not in (*_STARTS, "ts"):
        return 0
    layout = system.coordinates if name in ("q0", "v0") else None
    if name == "x0" and system.states is not None:
        layout = system.states.layout
    if keys:
        return 0 if layout is None else len(layout.shapes.get(str(keys[0]), ()))
    number = layout is not None and layout.size == 1 and x.ndim == 1 and x.shape != (1,)
    return 0 if number else 1


def _is_repeated(x: Any) -> bool:
    """Whether an array is one entry that `np.broadcast_to` has repeated."""
    return isinstance(x, np.ndarray) and x.ndim > 0 and x.shape[0] > 1 and x.strides[0] == 0


def _indexable(x: Any) -> Any:
    """An array of numpy, whose entries cost no dispatch; random keys are none."""
    return x if jax.dtypes.issubdtype(x.dtype, jax.dtypes.extended) else np.asarray(x)


def _number_of(n: Any, lengths: Mapping[str, int]) -> int:
    """Number of cases by n, or by leading axes, which must agree."""
    count = None if n is None else positive_integer("n", n)
    if count is None and not lengths:
        fix = "Give what differs between trajectories as arrays, one entry for each, or n."
        raise invalid("cases", "have an array with a leading axis", "it had none", fix)
    first = "n"
    if count is None:
        first, count = next(iter(lengths.items()))
    for name, length in lengths.items():
        if length != count:
            must, was = f"have a leading axis of {count}, as {first}", f"that was {length}"
            fix = f"Of one value for all write np.broadcast_to(x, ({count}, *x.shape))."
            raise invalid(name, must, was, fix)
    return positive_integer("n", count)
