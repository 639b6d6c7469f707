"""Params split into traced values and the static key of the program; when this recompiles."""

from collections import Counter
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag._tracing._params import Static, join, split


class Spring(eqx.Module):
    stiffness: jax.Array
    exponent: int
    law: object = eqx.field(static=True)


def square(x):
    return x**2


def cube(x):
    return x**3


TREE = {
    "number": 1.5,
    "array": np.array([1.0, 2.0]),
    "single": np.float32(2.5),
    "count": 3,
    "flag": True,
    "text": "tube",
    "law": square,
    "table": np.array([[1, 2], [3, 4]]),
    "mask": jnp.array([True, False]),
    "nothing": None,
    "nested": (Spring(jnp.array(2.0), 4, square), [0.5, -1]),
}


def test_split_traces_real_numbers_only():
    traced, static = split(TREE)
    real = {"number": 1.5, "array": [1.0, 2.0], "single": 2.5, "table": [[1, 2], [3, 4]]}
    for name, value in real.items():
        assert isinstance(traced[name], jax.Array)
        np.testing.assert_array_equal(traced[name], value)
        assert static[name] is None
    assert {name for name, value in traced.items() if value is not None} == {*real, "nested"}
    spring, numbers = traced["nested"]
    assert (float(spring.stiffness), spring.exponent, [float(numbers[0]), numbers[1]]) == (
        2.0,
        None,
        [0.5, None],
    )
    assert (static["count"], static["flag"], static["text"], static["law"]) == (
        3,
        True,
        "tube",
        square,
    )


def test_join_inverts_split():
    back = join(*split(TREE))
    assert jax.tree.structure(back) == jax.tree.structure(TREE)
    for found, given in zip(jax.tree.leaves(back), jax.tree.leaves(TREE), strict=True):
        if isinstance(given, str | bool | int) or callable(given):
            assert found is given
        else:
            np.testing.assert_array_equal(found, given)
            assert jnp.result_type(found) == jnp.result_type(given)
    assert isinstance(back["mask"], np.ndarray)
    assert jnp.issubdtype(back["table"].dtype, jnp.integer)
    assert back["nested"][0].law is square


@pytest.mark.parametrize("tree", [None, (), {}, 2.0, 3, [None, {"a": None}]])
def test_join_inverts_split_of_any_pytree(tree):
    assert join(*split(tree)) == tree
    assert hash(Static(split(tree)[1])) == hash(Static(split(tree)[1]))


def test_tracers_are_traced_whatever_their_type():
    seen = []

    @jax.jit
    def look(tree):
        traced, static = split(tree)
        seen.append((set(traced), jax.tree.leaves(static)))
        return join(traced, static)

    found = look({"count": 3, "number": 1.0})
    assert seen == [({"count", "number"}, [])]
    assert int(found["count"]) == 3


def key(tree):
    return Static(split(tree)[1])


def test_equal_static_parts_have_equal_keys():
    for make in (
        lambda: {"n": 3, "s": "tube", "f": square, "flag": True},
        lambda: {"mask": np.array([True, False]), "more": (np.int32(3), None)},
        lambda: {"mask": jnp.array([[True], [False]])},
    ):
        assert key(make()) == key(make())
        assert hash(key(make())) == hash(key(make()))
    assert key({"mask": np.array([True])}) == key({"mask": jnp.array([True])})
    assert key({"table": np.array([1, 2])}) == key({"table": jnp.array([3, 4])})
    assert key({"m": 1.0, "n": 2}) == key({"m": 7.0, "n": 2})
    assert key({"m": 1.0}) == key({"m": np.float64(2.0)}) == key({"m": jnp.ones(3)})


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (1, 2),
        (1, 1.0),
        (1, True),
        (0, False),
        (1, np.int64(1)),
        (np.int32(1), np.int64(1)),
        (1, np.array(True)),
        ("a", "b"),
        (square, cube),
        (None, 0),
        (np.array([True, False]), np.array([False, True])),
        (np.array([True, False]), np.array([[True, False]])),
        ((1, 2), [1, 2]),
        ({"a": 1}, {"b": 1}),
        (Spring(1.0, 2, square), Spring(1.0, 2, cube)),
        (Spring(1.0, 2, square), Spring(1.0, 3, square)),
    ],
)
def test_different_static_parts_have_different_keys(one, other):
    assert key({"x": one}) != key({"x": other})
    assert key({"x": one}) == key({"x": one})


def test_keys_copy_their_arrays():
    """Later changes of the original array have no effect: a Solution stores its params this way."""
    mask = np.array([True, False])
    static = split({"mask": mask})[1]
    mask[0] = False
    np.testing.assert_array_equal(join({"mask": None}, static)["mask"], [True, False])


# ---- Compiled programs ---------------------------------------------------------------------------


class Counted:
    """A system that counts how often its Lagrangian is traced; V = k |x|^n/n."""

    def __init__(self):
        self.traces = Counter()

        def lagrangian(t, q, v, params):
            self.traces["L"] += 1
            if params is None:
                return 0.5 * v[0] ** 2
            n, k = params["n"], params["k"] * {"double": 2, "triple": 3}.get(params.get("scale"), 1)
            k = k * int(np.sum(params.get("mask", 1)))
            if "table" in params:
                k = k * jnp.sum(params["table"]).astype(float)
            return 0.5 * params["m"] * v[0] ** 2 - k * q[0] ** n / n

        self.system = jl.System(lagrangian, ("x",))

    def run(self, params, q0=2.0, v0=0.0, ts=(0.0, 0.5), dt=0.5, **options):
        """One Euler step: v = -dt k q0^(n - 1)/m. Returns v and whether anything was traced."""
        before = self.traces["L"]
        motion = jl.simulate(self.system, [q0], [v0], ts, params, method="euler", dt=dt, **options)
        return float(motion.v[-1, 0]), self.traces["L"] > before


@pytest.fixture(scope="module")
def counted(lowering):
    counted = Counted()
    assert counted.run({"m": 1.0, "k": 3.0, "n": 2}) == (-3.0, True)
    return counted


@pytest.mark.parametrize(
    ("params", "expected"),
    [
        ({"m": 1.0, "k": 3.0, "n": 2}, -3.0),
        ({"m": 2.0, "k": 3.0, "n": 2}, -1.5),
        ({"m": 1.0, "k": 0.0, "n": 2}, 0.0),
        ({"m": -4.0, "k": 3.0, "n": 2}, None),
    ],
)
def test_new_values_do_not_recompile(counted, params, expected):
    run = counted.run if expected is not None else partial(counted.run, throw=False)
    found, traced = run(params)
    assert not traced
    if expected is None:
        assert np.isnan(found)  # M = -4: refused by the status, in the same program
    else:
        assert found == expected


def test_new_starts_times_and_steps_do_not_recompile(counted):
    params = {"m": 1.0, "k": 3.0, "n": 2}
    assert counted.run(params, q0=1.0) == (-1.5, False)
    assert counted.run(params, v0=1.0) == (-2.0, False)
    assert counted.run(params, ts=(7.0, 7.5)) == (-3.0, False)
    assert counted.run(params, ts=np.array([0.0, 0.25]), dt=0.25) == (-1.5, False)


def test_an_array_for_a_python_number_compiles_once_more(counted):
    """A Python float takes the state's precision; a numpy number or array has its own."""
    params = {"m": np.array(2.0), "k": np.float64(3.0), "n": 2}
    assert counted.run(params)[0] == -1.5
    assert counted.run({"m": jnp.ones(()) * 4, "k": np.array(3.0), "n": 2}) == (-0.75, False)
    assert counted.run({"m": 4.0, "k": 3.0, "n": 2}) == (-0.75, False)


def test_new_integer_compiles_a_new_program(counted):
    assert counted.run({"m": 1.0, "k": 3.0, "n": 3}) == (-6.0, True)
    assert counted.run({"m": 2.0, "k": 3.0, "n": 3}) == (-3.0, False)
    assert counted.run({"m": 1.0, "k": 3.0, "n": 2}) == (-3.0, False)


def test_new_text_or_mask_compiles_a_new_program(counted):
    """New values of an integer table do not recompile."""

    def run(**static):
        return counted.run({"m": 1.0, "k": 3.0, "n": 2} | static)

    assert run(scale="double") == (-6.0, True)
    assert run(scale="triple") == (-9.0, True)
    assert run(scale="double") == (-6.0, False)
    assert run(mask=np.array([True, True])) == (-6.0, True)
    assert run(mask=np.array([True, False])) == (-3.0, True)
    assert run(table=np.array([4, 5])) == (-27.0, True)
    assert run(table=np.array([4, 6])) == (-30.0, False)
    assert run(table=jnp.array([4, 5])) == (-27.0, False)


def test_params_may_be_left_out(counted):
    assert counted.run(None, v0=0.25) == (0.25, True)
    assert counted.run(None, v0=0.75) == (0.75, False)


# ---- What params must be -------------------------------------------------------------------------

NAN = np.nan


def pulled(t, q, v, params):
    return 0.5 * params["m"] * v[0] ** 2 - params["k"][0] * q[0] ** 2


def run(params):
    system = jl.System(pulled, ("x",))
    return jl.simulate(system, 1, 0, [0, 1], params, dt=0.5, method="heun", throw=False)


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"m": NAN, "k": [1.0]}, r"^`params\['m'\]` must be finite, but it was nan\."),
        ({"m": 1.0, "k": [np.inf]}, r"^`params\['k'\]\[0\]` must be finite, but it was inf\."),
        (
            {"m": 1.0, "k": np.array([1.0, NAN])},
            r"^`params\['k'\]\[1\]` must be finite, but it was nan\.",
        ),
        (
            {"m": 1.0, "k": [1.0], "s": {1, 2}},
            r"^`params\['s'\]` must be .* immutable and hashable .*\{1, 2\}",
        ),
    ],
)
def test_invalid_leaf_is_named_by_its_path(params, message):
    with pytest.raises(ValueError, match=message):
        run(params)


def test_invalid_leaf_is_named_under_derivatives():
    """The differentiated leaf, and another one."""
    for name in ("m", "k"):

        def end(x, name=name):
            return run({"m": x, "k": [1.0]} if name == "m" else {"m": x, "k": [NAN]}).q[-1, 0]

        with pytest.raises(ValueError, match=rf"^`params\['{name}'\].*` must be finite") as caught:
            jax.grad(end)(NAN if name == "m" else 1.0)
        assert "racer" not in str(caught.value)


def test_random_keys_are_traced():
    """A new key does not recompile; functions that read it get its value."""

    def noisy(t, q, v, params):
        return 0.5 * v[0] ** 2 - jax.random.uniform(params["key"], dtype=q.dtype) * q[0]

    system = jl.System(noisy, ("x",))
    ends = []
    for seed in (0, 1):
        key = jax.random.key(seed)
        motion = jl.simulate(system, [0.0], [0.0], [0.0, 1.0], {"key": key}, dt=0.5, method="heun")
        np.testing.assert_allclose(motion["x"][-1], -0.5 * jax.random.uniform(key), rtol=1e-12)
        ends.append(float(motion["x"][-1]))
    assert ends[0] != ends[1]
    traced, _ = split({"key": jax.random.key(0)})
    assert traced["key"] is not None


def test_integers_are_accepted_as_real_numbers():
    """States, times and inputs; one coordinate needs no brackets."""
    force = jl.GeneralizedForce(lambda t, q, v, params, inputs: inputs["f"] * jnp.ones(1), "f")
    system = jl.System(pulled, ("x",), forces=(force,))
    params = {"m": 2.0, "k": [1.0]}
    options = {"dt": 0.5, "method": "heun"}
    whole = jl.simulate(system, 1, 0, [0, 1], params, inputs={"f": 3}, **options)
    real = jl.simulate(system, [1.0], [0.0], [0.0, 1.0], params, inputs={"f": 3.0}, **options)
    np.testing.assert_array_equal(whole.q, real.q)
    assert whole.q.dtype == real.q.dtype
