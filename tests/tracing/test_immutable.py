"""Static leaves of params must be immutable: they are part of the key of compiled programs."""

import enum
import functools
import types
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag._tracing._params import check_keys

TABLE = {"k": 2.0}
STIFFNESS = 2.0
FACTORS = [1.0]


class Plain:
    def __init__(self, k):
        self.k = k

    def force(self, x):
        return self.k * x

    def __call__(self, x):
        return self.k * x


class Slots:
    __slots__ = ("k",)

    def __init__(self, k):
        self.k = k


@dataclass
class Data:
    k: Any


@dataclass(eq=False)
class ByIdentity:
    k: Any


@dataclass(frozen=True)
class Frozen:
    k: Any


@dataclass(frozen=True, eq=False)
class FrozenByIdentity:
    k: Any


class Law(enum.Enum):
    LINEAR = "linear"
    TABLE = [1.0]  # noqa: RUF012


class Static(eqx.Module):
    law: Any = eqx.field(static=True)

    def __call__(self, t):
        return self.law.k * t


class Pair(NamedTuple):
    k: Any


@jax.custom_jvp
def with_rule(x):
    return x


with_rule.defjvp(lambda primals, tangents: (primals[0], tangents[0]))


def of_table(x):
    return TABLE["k"] * x


def of_default(x, k=FACTORS):
    return k[0] * x


def of_number(x):
    return STIFFNESS * x


def through_helper(x):
    return of_table(x)


def closing_over(k):
    return lambda x: k * x


def weighed(x, k):
    return k * x


REFUSED = {
    "object": (Plain(1.0), "a Plain can change in place. Make its class an eqx.Module or"),
    "slots": (Slots(1.0), "a Slots can change"),
    "dataclass": (
        Data(1.0),
        r"a Data can change in place. Register its class, jax.tree_util.register_dataclass\(Data\)",
    ),
    "dataclass by identity": (ByIdentity(1.0), r"a ByIdentity can .* or make it an eqx.Module"),
    "frozen with a list": (Frozen([1.0]), "its field 'k', a list, can change"),
    "frozen with an object": (Frozen((Plain(1.0),)), "its element 0 of its field 'k', a Plain,"),
    "frozen by identity": (FrozenByIdentity([1.0]), "its field 'k', a list,"),
    "frozen with an array": (Frozen(jnp.ones(2)), "it is not hashable. Register its class"),
    "namespace": (
        types.SimpleNamespace(k=1.0),
        "SimpleNamespace can .* Write a dict, for example by vars",
    ),
    "class": (Plain, "a class can change in place. Write a dict of the numbers"),
    "module": (types.ModuleType("settings"), "a module can change in place. Write a dict of"),
    "generator": (np.random.default_rng(0), "a Generator can change"),
    "set": ({1, 2}, "a set can change in place. Write a tuple for a set"),
    "enum": (Law.TABLE, "its value, a list,"),
    "function of a dict": (
        of_table,
        "'TABLE', which it reads from outside, a dict, .* Pass in params",
    ),
    "function of such a function": (through_helper, "'TABLE', which it reads from outside, a dict"),
    "default": (of_default, "'k', which it reads from outside, a list,"),
    "closure": (closing_over([1.0]), "'k', which it reads from outside, a list,"),
    "closure of numpy": (closing_over(np.ones(2)), "'k', .*, a ndarray,"),
    "closure of an object": (lambda x: REFUSED["object"][0].k * x, "'REFUSED', .*, a dict,"),
    "partial": (functools.partial(weighed, k=[1.0]), "'k', .*, a list,"),
    "compiled partial": (jax.jit(functools.partial(weighed, TABLE)), r"'args\[0\]', .*, a dict,"),
    "mapped": (jax.vmap(of_table), "'TABLE', .*, a dict,"),
    "method": (Plain(1.0).force, "'self', .*, a Plain,"),
    "builtin method": (TABLE.get, "'self', .*, a dict,"),
}
FIXED = {
    "int": 3,
    "text": "tube",
    "bytes": b"tube",
    "none": None,
    "enum": Law.LINEAR,
    "tuple": (1, "a"),
    "frozenset": frozenset({1, 2}),
    "frozen": Frozen((1.0, "a")),
    "frozen with a function": Frozen(jnp.tanh),
    "dtypes": (jnp.float32, np.dtype("float32"), np.float64, float),
    "relu": jax.nn.relu,
    "softplus": jax.nn.softplus,
    "gelu": jax.nn.gelu,
    "tanh": jnp.tanh,
    "ufuncs": (jnp.add, np.tanh),
    "partial": functools.partial(jax.nn.leaky_relu, negative_slope=0.1),
    "custom_jvp": with_rule,
    "closure": closing_over(2.0),
    "closure of an array": closing_over(jnp.ones(2)),
    "transformed": (jax.jit(closing_over(2.0)), jax.vmap(jnp.sin), jax.grad(closing_over(2.0))),
    "network": eqx.nn.MLP(1, 1, 2, 1, activation=jax.nn.softplus, key=jax.random.key(0)),
    "with lambda": eqx.nn.MLP(
        1, 1, 2, 1, activation=lambda x: x * jax.nn.sigmoid(x), key=jax.random.key(0)
    ),
    "static function": Static(jnp.tanh),
    "function of jaxlag's": jl.math.norm,
}


@pytest.mark.parametrize("name", REFUSED)
def test_mutable_leaves_are_refused_by_path(name):
    leaf, message = REFUSED[name]
    must = r"^`params\['a'\]\[0\]` must be a number, an array, or an immutable and hashable object"
    with pytest.raises(ValueError, match=f"{must}.*{message}"):
        check_keys({"a": [leaf]})


@pytest.mark.parametrize("name", REFUSED)
def test_mutable_static_fields_are_refused(name):
    leaf, _ = REFUSED[name]
    with pytest.raises(ValueError, match=r"^`params\['a'\]\.law` must be "):
        check_keys({"a": Static(leaf)})


@pytest.mark.parametrize("name", FIXED)
def test_immutable_leaves_are_accepted(name):
    for _ in range(2):
        check_keys({"a": FIXED[name], "b": Pair(FIXED[name])})


def pulled(t, q, v, params):
    return 0.5 * v @ v - params["spring"].k * q[0] ** 2


SYSTEM = jl.System(pulled, ("x",))
RECORD = jl.Experiment([0.0, 0.1, 0.2], {"x": [1.0, 0.98, 0.93]}, q0=[1.0], v0=[0.0])


@pytest.mark.parametrize(
    "ask",
    [
        lambda params: jl.simulate(SYSTEM, [1.0], [0.0], [0.0, 1.0], params),
        lambda params: jl.equilibrium(SYSTEM, [0.1], params),
        lambda params: jl.assemble(SYSTEM, [0.1], [0.0], params),
        lambda params: jl.inverse_dynamics(SYSTEM, [1.0], [0.0], [0.0], params),
        lambda params: jl.fit(SYSTEM, [RECORD], params | {"m": 1.0}, free=("m",)),
        lambda params: jl.predict(SYSTEM, [RECORD], params),
        lambda params: SYSTEM.acceleration([1.0], [0.0], params),
        lambda params: SYSTEM.mass_matrix([1.0], params=params),
        lambda params: SYSTEM.explain(params),
    ],
)
def test_all_compiled_functions_refuse_mutable_leaves(ask):
    with pytest.raises(ValueError, match=r"^`params0?\['spring'\]` must be .* a Plain can change"):
        ask({"spring": Plain(1.0)})


@pytest.mark.parametrize("make", [Plain, Data, Frozen, lambda k: types.SimpleNamespace(k=k)])
def test_mutable_leaves_are_refused_under_derivatives(make):
    def end(k):
        return jl.simulate(SYSTEM, [1.0], [0.0], [0.0, 1.0], {"spring": make(k)}).q[-1, 0]

    with pytest.raises(
        ValueError, match=r"^`params0?\['spring'\]` must be .*eqx.Module|a dict"
    ) as it:
        jax.grad(end)(1.0)
    assert "racer" not in str(it.value)


def test_energies_without_a_program_read_current_values():
    spring = Plain(1.0)
    for k in (1.0, 5.0):
        spring.k = k
        assert SYSTEM.energy([1.0], [0.0], {"spring": spring}) == k


def test_functions_that_read_a_changed_number_are_refused(monkeypatch):
    """As a leaf and in a static field; otherwise the program would hold the former number."""
    params = {"law": of_number}, {"law": Static(of_number)}, {"law": Frozen(of_number)}
    for each in params:
        check_keys(each)
    monkeypatch.setitem(globals(), "STIFFNESS", 5.0)
    message = "STIFFNESS, which it reads from outside, was 2.0 before and is 5.0 now"
    for each in params:
        with pytest.raises(ValueError, match=rf"^`params\['law'\].*` must .*{message}"):
            check_keys(each)


def test_declared_modules_must_be_immutable():
    with pytest.raises(ValueError, match=r"^`Static\.law` must be .* a Plain can change"):
        jl.TimeFunction(Static(Plain(1.0)))


def test_channels_of_a_fit_must_be_immutable():
    with pytest.raises(ValueError, match=r"^`channels\['x'\]` must be .* 'TABLE', which it reads"):
        jl.fit(
            SYSTEM,
            [RECORD],
            {"m": 1.0},
            free=("m",),
            channels={"x": lambda motion: TABLE["k"] * motion["x"]},
        )
