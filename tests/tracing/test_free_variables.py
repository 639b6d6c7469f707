"""Free variables of declared functions: a change is reported and has no effect."""

from enum import Enum
from functools import partial, wraps
from types import ModuleType, SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl


def _array_in_place():
    k = np.array([2.0])

    def change():
        k[0] = 5.0

    return lambda t, q, v, params: 0.5 * v @ v - k @ q, change, "k"


def _array_in_a_compiled_helper():
    k = np.array([2.0])

    @jax.jit
    def potential(q):
        return jnp.asarray(k) @ q

    def change():
        k[0] = 5.0

    return lambda t, q, v, params: 0.5 * v @ v - potential(q), change, "k"


def _number_of_numpy_in_place():
    k = np.array(2.0)

    def change():
        k[...] = 5.0

    return lambda t, q, v, params: 0.5 * v @ v - k * q[0], change, "k"


def _helper():
    def potential(q):
        return 2.0 * q[0]

    def change():
        nonlocal potential
        potential = jnp.sum

    return lambda t, q, v, params: 0.5 * v @ v - potential(q), change, "potential"


def _dict():
    given = {"g": [2.0]}

    def change():
        given["g"][0] = 5.0

    return lambda t, q, v, params: 0.5 * v @ v - given["g"][0] * q[0], change, "given"


def _attribute():
    given = SimpleNamespace(g=2.0, other=object())

    def change():
        given.g = 5.0

    return lambda t, q, v, params: 0.5 * v @ v - given.g * q[0], change, r"given\.g"


def _method():
    class Body:
        g = 2.0

        def __init__(self):
            self.g = 2.0

        def lagrangian(self, t, q, v, params):
            return 0.5 * v @ v - self.g * q[0]

    body = Body()

    def change():
        body.g = 5.0

    return body.lagrangian, change, r"self\.g"


class _Body:
    factor = 1.0

    def __init__(self, g):
        self.g = g

    @property
    def weight(self):
        return self.g

    def potential(self, q):
        return self.weight * q[0]


class _Law(_Body):
    def __call__(self, t, q, v, params):
        return 0.5 * v @ v - self.potential(q)


def _heavier(body):
    def change():
        body.g = 5.0

    return change


def _instance():
    body = _Law(2.0)
    return body, _heavier(body), r"self\.g"


def _method_of_an_object():
    body = _Body(2.0)
    return lambda t, q, v, params: 0.5 * v @ v - body.potential(q), _heavier(body), r"self\.g"


def _object_in_an_object():
    world = SimpleNamespace(body=_Body(2.0))
    change, name = _heavier(world.body), r"world\.body\.g"
    return lambda t, q, v, params: 0.5 * v @ v - world.body.g * q[0], change, name


def _objects_in_a_list():
    bodies = [_Body(2.0)]
    change, name = _heavier(bodies[0]), r"bodies\[0\]\.g"
    return lambda t, q, v, params: 0.5 * v @ v - sum(b.g for b in bodies) * q[0], change, name


def _another_object_in_a_list():
    bodies = [_Body(2.0)]

    def change():
        bodies.append(_Body(1.0))

    L = lambda t, q, v, params: 0.5 * v @ v - sum(b.g for b in bodies) * q[0]  # noqa: E731
    return L, change, r"len\(bodies\)"


def _attribute_of_a_class():
    class Earth:
        g = 2.0

    def change():
        Earth.g = 5.0

    return lambda t, q, v, params: 0.5 * v @ v - Earth.g * q[0], change, r"Earth\.g"


def _slot():
    class Earth:
        __slots__ = ("g",)

    earth = Earth()
    earth.g = 2.0

    def change():
        earth.g = 5.0

    return lambda t, q, v, params: 0.5 * v @ v - earth.g * q[0], change, r"earth\.g"


def _module_of_the_user():
    settings: Any = ModuleType("settings")
    settings.g = 2.0

    def change():
        settings.g = 5.0

    return lambda t, q, v, params: 0.5 * v @ v - settings.g * q[0], change, r"settings\.g"


def _default():
    k = [2.0]

    def lagrangian(t, q, v, params, k=k):
        return 0.5 * v @ v - k[0] * q[0]

    return lagrangian, lambda: k.__setitem__(0, 5.0), "k"


def _partial():
    given = {"g": 2.0}

    def lagrangian(t, q, v, params, given):
        return 0.5 * v @ v - given["g"] * q[0]

    return partial(lagrangian, given=given), lambda: given.update(g=5.0), "given"


def _keyword_of_a_partial():
    def lagrangian(t, q, v, params, g):
        return 0.5 * v @ v - g * q[0]

    whole = partial(lagrangian, g=2.0)
    return whole, lambda: whole.keywords.update(g=5.0), "g"


def _wrapped():
    k = [2.0]

    def free(t, q, v, params):
        return 0.5 * v @ v

    @wraps(free)
    def lagrangian(*at):
        return free(*at) - k[0] * at[1][0]

    return lagrangian, lambda: k.__setitem__(0, 5.0), "k"


def _none():
    given = SimpleNamespace(g=None)

    def change():
        given.g = 5.0

    def lagrangian(t, q, v, params):
        return 0.5 * v @ v - (2.0 if given.g is None else given.g) * q[0]

    return lagrangian, change, r"given\.g"


def _large_array():
    k = np.full(300_000, 2.0)

    def change():
        k[:] = 5.0

    return lambda t, q, v, params: 0.5 * v @ v - k[0] * q[0], change, "k"


class _Rule(Enum):
    LINEAR = 1

    def stiffness(self):
        return _RULES["k"]


class _Pair(NamedTuple):
    x: float = 1.0

    def stiffness(self):
        return _RULES["k"]


class _Word(str):
    def stiffness(self):
        return _RULES["k"]


_RULES = {"k": 2.0}


def _method_of(x):
    _RULES["k"] = 2.0

    def lagrangian(t, q, v, params):
        return 0.5 * v @ v - x.stiffness() * q[0]

    return lagrangian, lambda: _RULES.update(k=5.0), "_RULES"


def _own_attribute():
    def lagrangian(t, q, v, params):
        return 0.5 * v @ v - lagrangian.k * q[0]  # pyright: ignore[reportFunctionMemberAccess]

    lagrangian.k = 2.0  # pyright: ignore[reportFunctionMemberAccess]
    return lagrangian, lambda: setattr(lagrangian, "k", 5.0), r"lagrangian\.k"


def _global_by_its_name():
    _RULES["k"] = 2.0

    def lagrangian(t, q, v, params):
        return 0.5 * v @ v - globals()["_RULES"]["k"] * q[0]

    return lagrangian, lambda: _RULES.update(k=5.0), "_RULES"


OUTSIDE = [
    partial(_method_of, _Rule.LINEAR),
    partial(_method_of, _Pair()),
    partial(_method_of, _Word("a")),
    _own_attribute,
    _global_by_its_name,
    _instance,
    _method_of_an_object,
    _object_in_an_object,
    _objects_in_a_list,
    _another_object_in_a_list,
    _attribute_of_a_class,
    _slot,
    _module_of_the_user,
    _default,
    _partial,
    _keyword_of_a_partial,
    _wrapped,
    _none,
    _large_array,
    _array_in_place,
    _array_in_a_compiled_helper,
    _number_of_numpy_in_place,
    _helper,
    _dict,
    _attribute,
    _method,
]


@pytest.mark.full
@pytest.mark.parametrize("declared", OUTSIDE)
def test_changed_free_variables_are_named_and_have_no_effect(declared):
    lagrangian, change, name = declared()
    system = jl.System(lagrangian, ("x",))
    at = [0.0], [0.0], {}
    assert system.acceleration(*at) == -2.0
    change()
    with pytest.warns(UserWarning, match=f"^{name}, which .* reads from outside, was .* now"):
        assert system.acceleration(*at) == -2.0  # a compiled program warns, too
    with pytest.warns(UserWarning, match=f"^{name}, which .* reads from outside, was .* now"):
        assert system.energy([1.0], [0.0], {}) == 2.0
