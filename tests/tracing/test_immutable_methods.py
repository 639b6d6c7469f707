"""Values that objects in params read by methods, properties and attributes: one rule for all.

Mutable values are refused at once, a number only after a change.
"""

import argparse
import collections
import enum
import functools
import logging
import os
import sys
import types
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest

import jaxlag as jl
from jaxlag._tracing._params import check_keys
from jaxlag._tracing._traced_function import traced_function

TABLE = {"k": 2.0}
STIFFNESS = 2.0
NUMBERS = (1.0, 2.0)
LOG = logging.getLogger(__name__)


def of_table():
    return TABLE["k"]


class PairOfTable(NamedTuple):
    x: float = 1.0

    def k(self):
        return TABLE["k"]


class PairOfNumber(NamedTuple):
    x: float = 1.0

    @property
    def k(self):
        return STIFFNESS


class PairOfFields(NamedTuple):
    x: float = 1.0

    def k(self):
        return self.x * NUMBERS[0]


class Plain:
    k = 1.0


@jax.tree_util.register_pytree_node_class
class Registered(dict):
    def __init__(self, given, aux):
        super().__init__(given)
        self.aux = aux

    def tree_flatten(self):
        return list(self.values()), (tuple(self), self.aux)

    @classmethod
    def tree_unflatten(cls, data, children):
        return cls(zip(data[0], children, strict=True), data[1])


jax.tree_util.register_pytree_node(
    argparse.Namespace,
    lambda x: ((x.x,), x.settings),
    lambda data, children: argparse.Namespace(x=children[0], settings=data),
)


class LawOfTable(enum.Enum):
    A = 1

    def k(self):
        return TABLE["k"]


class LawOfNumber(enum.Enum):
    A = 1

    def k(self):
        return STIFFNESS


class Planet(enum.Enum):
    EARTH = (1.0, 2.0)

    def __init__(self, mass, radius):
        self.mass = mass
        self.radius = radius

    @functools.cached_property
    def weight(self):
        return self.mass / self.radius**2


class Listed(enum.Enum):
    A = 1


Listed.A.k = [4.0]  # pyright: ignore[reportAttributeAccessIssue]


class ByPartial(enum.Enum):
    A = functools.partial(lambda x: STIFFNESS * x)


class Text(str):
    def k(self):
        return TABLE["k"]


class Whole(int):
    pass


class Bytes(bytes):
    pass


class Several(tuple):
    pass


class Some(frozenset):
    pass


class Decimal(float):
    pass


def of_own_attribute():
    return of_own_attribute.k


of_own_attribute.k = 1.0


def of_own_list():
    return of_own_list.k[0]


of_own_list.k = [1.0]


def by_default(x=0.0, k=2.0):
    return k * x


def by_code():
    return 2.0


def by_instance():
    return Named("k").k


@jax.custom_jvp
def with_rule(x):
    return x


with_rule.k = 2.0  # pyright: ignore[reportAttributeAccessIssue]


@functools.singledispatch
def dispatched_purely(x):
    return x


def counting():
    counting.count += 1
    return 1.0


counting.count = 0


def by_globals():
    return globals()["STIFFNESS"]


def by_globals_of_another():
    return of_table.__globals__["STIFFNESS"]


def by_eval():
    return eval("STIFFNESS * 2")


def by_modules():
    return sys.modules[__name__].STIFFNESS


def by_environment():
    return float(os.environ["STIFFNESS"])


@functools.singledispatch
def dispatched(x):
    return x


@dispatched.register
def _(x: float):
    return TABLE["k"] * x


class Module(eqx.Module):
    k: float = 1.0


class OfTable(Module):
    def law(self):
        return TABLE["k"]


class OfNumber(Module):
    def law(self):
        return STIFFNESS


class OfClass(Module):
    factor: ClassVar[float] = 2.0


class OfClassTable(Module):
    factors: ClassVar[dict] = {"k": 2.0}


class Compiled(Module):
    @jax.jit
    def law(self):
        return TABLE["k"]


class CompiledByEquinox(Module):
    @eqx.filter_jit
    def law(self):
        return TABLE["k"]


class Remembered(Module):
    @functools.lru_cache  # noqa: B019
    def law(self):
        return TABLE["k"]


class ByName(Module):
    def __getattr__(self, name):
        return TABLE[name]


class Descriptor:
    def __get__(self, owner, kind=None):
        return TABLE["k"]


class Described(Module):
    law: ClassVar = Descriptor()


class Named(Module):
    """Reads a global when constructed, a log and a constant: none affects the motion."""

    def __init__(self, name):
        self.k = TABLE[name]

    @classmethod
    def steel(cls):
        return cls("k")

    def __call__(self, x):
        LOG.info("called")
        return self.k * NUMBERS[0] * jnp.sin(x)

    def plot(self):
        from matplotlib import pyplot

        return pyplot.plot([self(0.0)])


@dataclass(frozen=True)
class Frozen:
    k: Any = 1.0

    def __post_init__(self):
        object.__setattr__(self, "double", 2.0)

    def law(self):
        return NUMBERS[1]


@dataclass(frozen=True)
class FrozenOfTable:
    @functools.cached_property
    def law(self):
        return TABLE["k"]


@dataclass(frozen=True)
class FrozenOfNumber:
    def law(self):
        return STIFFNESS


@dataclass(frozen=True)
class Uncompared:
    k: float = field(default=1.0, compare=False)


@dataclass(frozen=True)
class Equal:
    k: float = 1.0

    def __eq__(self, other):
        return True

    def __hash__(self):
        return 1


def of_circle():
    return CIRCLE.k


CIRCLE = Frozen(of_circle)


class Static(eqx.Module):
    law: Any = eqx.field(static=True)


METHODS = "'TABLE', which its methods read from outside, a dict, can change in place. Make it a"
READS = "which it reads from outside, a dict, can change in place. Pass in params"
REFUSED = {
    "named tuple": (PairOfTable(), METHODS),
    "data of a dict": (Registered({"x": 1.0}, Plain()), "its element 1, a Plain, can .*eqx.Module"),
    "data of a namespace": (
        argparse.Namespace(x=1.0, settings=collections.UserDict(k=1.0)),
        "an? UserDict can change",
    ),
    "enum": (LawOfTable.A, METHODS),
    "attribute of an enum": (Listed.A, "its attribute 'k', a list, can change in place"),
    "class of an enum": (LawOfTable, METHODS),
    "str": (Text("a"), r"a Text is no plain str. Write str\(...\) of it"),
    "int": (Whole(1), r"a Whole is no plain int. Write int\(...\) of it"),
    "bytes": (Bytes(b"a"), r"a Bytes is no plain bytes. Write bytes\(...\)"),
    "tuple": (Several((1,)), r"a Several is no plain tuple. Write tuple\(...\)"),
    "frozenset": (Some({1}), r"a Some is no plain frozenset. Write frozenset\(...\)"),
    "in a tuple": (Frozen((Text("a"),)), "its element 0 of its field 'k', a Text, is no plain str"),
    "keys": ({Text("a"): 1.0}, "a Text is no plain str"),
    "default": (collections.defaultdict(of_table, {"a": 1.0}), f"'TABLE', {READS}"),
    "own attribute": (of_own_list, "'of_own_list.k', which it reads from outside, a list,"),
    "globals": (by_globals, f"'globals', {READS}"),
    "globals of another": (by_globals_of_another, f"'__globals__', {READS}"),
    "eval": (by_eval, f"'eval', {READS}"),
    "modules": (by_modules, f"'sys.modules', {READS}"),
    "environment": (by_environment, "'os.environ', which it reads from outside, an? _Environ,"),
    "dispatched": (dispatched, f"'TABLE', {READS}"),
    "module": (OfTable(), METHODS),
    "class variable": (OfClassTable(), "'OfClassTable.factors', which its methods read .* a dict,"),
    "compiled method": (Compiled(), METHODS),
    "method of equinox": (CompiledByEquinox(), METHODS),
    "cached method": (Remembered(), METHODS),
    "any attribute": (ByName(), METHODS),
    "descriptor": (Described(), "'Described.law', which its methods .* a Descriptor, can change"),
    "frozen": (FrozenOfTable(), METHODS),
    "uncompared": (Uncompared(), "its field 'k', a float, is excluded from comparisons"),
    "equal to all": (Equal(), "an Equal has an __eq__ method of its own"),
    "jitted by equinox": (eqx.filter_jit(of_table), f"'TABLE', {READS}"),
    "method of frozen": (PairOfTable().k, "'TABLE', which its methods read"),
    "slice": (slice(0, 2), "it is not hashable. Write a tuple of its bounds"),
    "view": (types.MappingProxyType(TABLE), "a mappingproxy is not hashable. Write a dict"),
    "iterator": (iter((1,)), "a tuple_iterator is not hashable. Write a tuple"),
}
if sys.version_info >= (3, 12):  # slices hash
    del REFUSED["slice"]
FIXED = {
    "named tuple": PairOfFields(),
    "data of a dict": Registered({"x": 1.0}, "a"),
    "enum": Planet.EARTH,
    "flags": enum.Flag("Flags", "A B")(3),
    "float": Decimal(1.0),
    "keys": {1: 1.0, 2: 2.0},
    "ordered": collections.OrderedDict(a=1.0),
    "default": collections.defaultdict(float, {"a": 1.0}),
    "module": Named.steel(),
    "frozen": Frozen(),
    "declared": Static(traced_function(of_own_attribute)),
    "circle": of_circle,
    "dispatched": dispatched_purely,
    "remembered": functools.lru_cache(lambda x: x),
    "counting": counting,
    "networks": (
        eqx.nn.MLP(1, 1, 2, 1, activation=jax.nn.softplus, key=jax.random.key(0)),
        eqx.nn.Sequential([eqx.nn.LayerNorm(2), eqx.nn.Lambda(jnp.tanh), eqx.nn.PReLU()]),
        eqx.nn.GRUCell(1, 2, key=jax.random.key(0)),
        eqx.nn.Conv1d(1, 1, 3, key=jax.random.key(0)),
        eqx.nn.MultiheadAttention(2, 2, key=jax.random.key(0)),
    ),
}
PARTIAL = functools.partial(of_own_attribute)
PARTIAL.k = 2.0  # pyright: ignore[reportAttributeAccessIssue]
# By the kind of change: the leaf, the changed place and the message.
NUMBER = "STIFFNESS, which its methods read from outside, was 2.0 before and is 5.0 now. Make it"
CHANGED = {
    "named tuple": (PairOfNumber(), "STIFFNESS", NUMBER),
    "enum": (LawOfNumber.A, "STIFFNESS", NUMBER),
    "value of an enum": (ByPartial.A, "STIFFNESS", "STIFFNESS, which it reads .* is 5.0 now"),
    "module": (OfNumber(), "STIFFNESS", NUMBER),
    "frozen": (FrozenOfNumber(), "STIFFNESS", NUMBER),
    "method of frozen": (FrozenOfNumber().law, "STIFFNESS", NUMBER),
    "where it is made": (Named.steel(), "TABLE", "TABLE, which its methods read .* is 5.0 now"),
    "attribute of an enum": (Planet.EARTH, (Planet.EARTH, "mass"), "Planet.EARTH.mass, which .*"),
    "own attribute": (
        of_own_attribute,
        (of_own_attribute, "k"),
        "of_own_attribute.k, which it reads from outside, was 1.0 before and is 5.0 now. Pass",
    ),
    "attribute of a partial": (PARTIAL, (PARTIAL, "k"), "partial.k, which it reads .* 2.0 before"),
    "attribute of custom_jvp": (with_rule, (with_rule, "k"), "with_rule.k, which it reads .* 2.0"),
    "made inside": (by_instance, "TABLE", "TABLE, which it reads .* is 5.0 now"),
    "class variable": (OfClass(), (OfClass, "factor"), "OfClass.factor, which its methods read"),
    "default": (by_default, (by_default, "__defaults__"), "k, which it reads .* was 2.0 before"),
    "code": (by_code, (by_code, "__code__"), "by_code.__code__, which it reads from outside"),
    "method": (OfNumber(), (OfNumber, "law"), "OfNumber.law, which its methods read .* now"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_mutable_values_are_refused_at_once(name):
    leaf, message = REFUSED[name]
    for _ in range(2):
        with pytest.raises(ValueError, match=rf"^`params\['a'\].*` must be .*{message}"):
            check_keys({"a": leaf})


@pytest.mark.parametrize("name", FIXED)
def test_immutable_values_are_accepted(name):
    for _ in range(2):
        check_keys({"a": FIXED[name]})
    if name == "counting":
        counting()
        check_keys({"a": counting})


@pytest.mark.parametrize("name", CHANGED)
def test_numbers_are_refused_after_a_change(name, monkeypatch):
    leaf, place, message = CHANGED[name]
    for _ in range(2):
        check_keys({"a": leaf})
    if isinstance(place, str):
        monkeypatch.setitem(globals(), place, 5.0)
    else:
        new = {"__defaults__": (0.0, 5.0), "__code__": (lambda: 5.0).__code__}
        monkeypatch.setattr(*place, new.get(place[1], 5.0))
    with pytest.raises(ValueError, match=rf"^`params\['a'\]` must be .*{message}"):
        check_keys({"a": leaf})


def test_programs_never_use_a_former_number(monkeypatch):
    system = jl.System(lambda t, q, v, p: 0.5 * v @ v - p["x"].k * q[0], ("x",))
    params = {"x": PairOfNumber()}
    assert system.acceleration([0.0], [0.0], params) == -2.0
    monkeypatch.setitem(globals(), "STIFFNESS", 5.0)
    with pytest.raises(
        ValueError, match=r"^`params\['x'\]` must be .*STIFFNESS, which its methods"
    ):
        system.acceleration([0.0], [0.0], params)
