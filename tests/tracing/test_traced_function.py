"""Declared functions are traced once: free variables keep their values at tracing."""

import pickle
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxpr_as_fun

import jaxlag as jl
from jaxlag._tracing._program_constants import copy_constants
from jaxlag._tracing._traced_function import traced_function

TS = jnp.array([0.0, 0.5, 1.0])
GRAVITY = 2.0


def fall(system, ts=TS):
    """Position at the end, energies, and acceleration at the end."""
    motion = jl.simulate(system, [0.0], [0.0], ts, {})
    return motion.q[-1, 0], motion.energy, system.acceleration(motion.q[-1], motion.v[-1], {})[0]


def changed(name, before, now):
    return pytest.warns(UserWarning, match=f"^{name}, which .* was {before} .* and is {now} now")


def test_globals_keep_their_value_at_tracing(monkeypatch):
    def lagrangian(t, q, v, params):
        return 0.5 * v @ v - GRAVITY * q[0]

    system = jl.System(lagrangian, ("x",))
    first = fall(system)
    np.testing.assert_allclose(first[0], -1.0, rtol=1e-9)
    monkeypatch.setitem(globals(), "GRAVITY", 5.0)
    for again in (system, jl.System(lagrangian, ("x",))):
        with changed("GRAVITY", "2.0", "5.0"):
            assert fall(again)[0] == first[0]
    with changed("GRAVITY", "2.0", "5.0"):
        where, energy, acceleration = fall(system, jnp.array([0.0, 1.0]))  # another program
    np.testing.assert_allclose(where, -1.0, rtol=1e-9)
    np.testing.assert_allclose(energy, 0.0, atol=1e-12)
    assert acceleration == -2.0


def test_redefined_functions_read_current_values(monkeypatch):
    def declare():
        return jl.System(lambda t, q, v, params: 0.5 * v @ v - GRAVITY * q[0], ("x",))

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert fall(declare())[2] == -2.0
        monkeypatch.setitem(globals(), "GRAVITY", 5.0)
        assert fall(declare())[2] == -5.0


def test_forces_constraints_and_quasi_velocities_are_traced_once():
    given = {"force": 2.0, "row": 1.0, "turn": 3.0}
    push = jl.GeneralizedForce(lambda t, q, v, params: given["force"] * jnp.ones(2), "push")
    row = jl.Pfaffian(lambda t, q, v, params: v[1] - given["row"] * v[0], "row")
    quasi = jl.QuasiVelocities(
        lambda t, q, v, params: jnp.stack([given["turn"] * v[0], v[1] - v[0]]), ("u", "w")
    )
    system = jl.System(
        lambda t, q, v, params: 0.5 * v @ v,
        ("x", "y"),
        forces=(push,),
        constraints=(row,),
        quasi=quasi,
    )

    def numbers():
        lam = system.multipliers([0.0, 0.0], [1.0, 1.0], {})["row"]
        u = system.quasi_velocities([0.0, 0.0], [1.0, 1.0], {})
        force = system.generalized_force([0.0, 0.0], [1.0, 1.0], {})
        return jnp.concatenate([jnp.ravel(x) for x in jax.tree.leaves((lam, u, force))])

    before = numbers()
    given |= {"force": 7.0, "row": 4.0, "turn": 5.0}
    with pytest.warns(UserWarning, match="^given, which"):
        np.testing.assert_array_equal(numbers(), before)


def test_unchanged_free_variables_give_no_warning():
    k, table = np.array([2.0]), {"a": [1.0, np.nan]}

    def lagrangian(t, q, v, params):
        return 0.5 * v @ v - k @ q * table["a"][0]

    system = jl.System(lagrangian, ("x",))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(2):
            assert system.acceleration([0.0], [0.0], {}) == -2.0
            k = k.copy()  # another array of the same numbers


def test_functions_are_traced_once_per_kind_of_arguments():
    calls = 0

    def lagrangian(t, q, v, params):
        nonlocal calls
        calls += 1
        return 0.5 * params["m"] * v @ v - params["n"] * q[0]

    system = jl.System(lagrangian, ("x",))
    params = {"m": jnp.array(1.0), "n": 2}
    motion = jl.simulate(system, [0.0], [0.0], TS, params)
    assert calls == 1
    motion.energy, motion.a, system.explain(params), system.acceleration([0.0], [1.0], params)
    jl.simulate(system, [0.0], [0.0], TS[:2], params)
    assert calls == 1
    system.energy([0.0], [1.0], params | {"n": 3})
    assert calls == 2
    system.check([0.0], [1.0], params)  # called with numbers, for functions that test values
    assert calls == 3


def test_lagrangian_of_a_system_is_reused_unchanged():
    system = jl.System(lambda t, q, v, params: 0.5 * v @ v, ("x",))
    again = jl.System(system.lagrangian, ("x",))
    assert again == system
    assert again.lagrangian is system.lagrangian
    assert traced_function(system.lagrangian.function) is system.lagrangian
    x = jnp.array([1.0])
    assert system.lagrangian(0.0, x, x, params=None) == 0.5


def _module_level(t, q, v, params):
    return 0.5 * v @ v


def test_attributes_of_callables_do_not_clash():
    """Of any name: the wrapper does not take them for its own."""

    class Spring:
        def __init__(self):
            self.function, self._programs, self._outside = (lambda *_: 1.0), None, None

        def __call__(self, t, q, v, params):
            return 0.5 * v @ v - 2.0 * q @ q

    system = jl.System(Spring(), ("x",))
    np.testing.assert_allclose(system.acceleration([0.5], [0.0], {}), [-2.0], rtol=1e-15)
    kinetic = lambda t, q, u, params: 0.5 * u @ u  # noqa: E731
    potential = lambda t, q, params: jnp.zeros(())  # noqa: E731
    quasi = jl.QuasiVelocities(lambda t, q, v, params: 3.0 * v, ("u",))
    inner = jl.System(
        coordinates=("x",), kinetic=kinetic, potential=potential, quasi=quasi, written_in="u"
    )
    outer = jl.System(inner.lagrangian, ("x",))  # an L of v derived from an L of u
    np.testing.assert_allclose(outer.mass_matrix([0.5], params={}), [[9.0]], rtol=1e-15)


def test_a_system_of_named_functions_is_pickled():
    system = jl.System(_module_level, ("x",))
    assert pickle.loads(pickle.dumps(system)) == system


def test_unhashable_params_work_for_energies():
    """They key no compiled program; energies need none."""
    system = jl.System(lambda t, q, v, p: 0.5 * len(p["names"]) * v @ v, ("x",))
    assert system.energy([0.0], [1.0], {"names": {"a", "b"}}) == 1.0


def test_an_input_is_traced_once():
    given = {"u": 2.0}
    push = jl.GeneralizedForce(lambda t, q, v, params, inputs: inputs["u"] * jnp.ones(1), "push")
    system = jl.System(lambda t, q, v, params: 0.5 * v @ v, ("x",), forces=(push,))
    inputs = {"u": jl.TimeFunction(lambda t: given["u"])}

    def forces(ts):
        return jl.simulate(system, [0.0], [0.0], ts, {}, inputs=inputs).Q

    before = forces(TS)
    given["u"] = 5.0
    with pytest.warns(UserWarning, match="^given, which .* was {'u': 2.0} .* is {'u': 5.0} now"):
        np.testing.assert_array_equal(forces(TS[:2]), before[:2])


def test_programs_copy_constants_and_share_the_rest():
    k = np.array([1.0, 2.0])

    @jax.jit
    def without(x):
        return jnp.sin(x)

    @jax.jit
    def with_array(x):
        return x @ jnp.asarray(k)

    code = jax.make_jaxpr(lambda x: without(x) @ x + with_array(x))(jnp.ones(2))
    mine = copy_constants(code)
    before, after = (
        {eqn.params["name"]: eqn.params["jaxpr"] for eqn in c.jaxpr.eqns if "jaxpr" in eqn.params}
        for c in (code, mine)
    )
    assert after["without"] is before["without"]
    expected = jaxpr_as_fun(mine)(jnp.ones(2))[0]
    k[:] = 7.0
    assert jaxpr_as_fun(mine)(jnp.ones(2))[0] == expected


# ---- Integers as numbers, functions in loops -----------------------------------------------------


def test_the_third_int_of_one_leaf_is_warned_about():
    """Each compiles anew; constant exponents and flags give no warning."""

    def stiff(t, q, v, params):
        kinetic = 0.5 * params["m"] * v[0] ** 2
        return kinetic - q[0] ** params["n"] if params["on"] else kinetic

    call = traced_function(stiff)

    def of(m, n=2, on=True):
        return call(jnp.array(0.0), jnp.ones(1), jnp.ones(1), {"m": m, "n": n, "on": on})

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for m, on in ((1, True), (2, False), (1.0, True), (2.0, True), (3.0, True), (2, True)):
            of(m, on=on)
    message = r"^params\['m'\] of .*stiff.* is the Python int 3"
    with pytest.warns(UserWarning, match=message) as warned:
        of(3)
    assert "Write 3.0 if it is a physical parameter" in str(warned[0].message)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        of(4)  # no second warning


def test_functions_defined_in_a_loop_are_logged_once(caplog):
    def made(k):
        return traced_function(lambda t: k * t)

    with caplog.at_level("WARNING", logger="jaxlag"):
        for k in range(25):
            made(float(k))(jnp.array(1.0))
    (record,) = caplog.records
    assert "was traced as a new function for the 20th time" in record.getMessage()
    assert "pass in params what changes" in record.getMessage()
