"""Structure of a Lagrangian from its program alone, and its description by `explain`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _families import mostly_full
from _systems.mechanics import GENERAL, chain

import jaxlag as jl
from jaxlag._lowering import find_structure
from jaxlag._tracing._dependence import outputs_depend_on
from systems.catalogue import ENTRIES

PAIR = ("x", "y")


def structure(lagrangian, params=None, coordinates=PAIR):
    return jl.System(lagrangian, coordinates)._structure(params, jnp.float64)


def of(name):
    if name in ENTRIES:
        return ENTRIES[name].system._structure(dict(ENTRIES[name].example.params), jnp.float64)
    return GENERAL[name].system._structure(GENERAL[name].params, jnp.float64)


# ---- Dependencies --------------------------------------------------------------------------------


def test_a_free_particle_has_a_constant_mass_and_no_bias():
    found = structure(lambda t, q, v, params: 0.5 * params["m"] * v @ v, {"m": 2.0})
    assert found == (frozenset({"params"}), frozenset(), frozenset({"v", "params"}), True)
    assert (found.quadratic, found.mass_constant, found.explicit_time) == (True, True, False)
    bare = structure(lambda t, q, v, params: 0.5 * v @ v)
    assert (bare.mass, bare.bias_zero, bare.mass_constant) == (frozenset(), True, True)


def test_constant_force_is_a_bias_without_dependencies():
    """Zero is distinguished from a constant by value."""
    found = structure(lambda t, q, v, params: 0.5 * v @ v - 9.81 * q[0])
    assert (found.bias, found.bias_zero) == (frozenset(), False)
    with_params = structure(lambda t, q, v, params: 0.5 * v @ v - params["g"] * q[0], {"g": 0.0})
    assert (with_params.bias, with_params.bias_zero) == (frozenset({"params"}), False)


def test_structure_does_not_depend_on_values_of_params():
    """k = 0 and k = 1 have the same structure: it is read from the program."""
    found = [
        structure(lambda t, q, v, params: 0.5 * v @ v - params["k"] * q @ q, {"k": k})
        for k in (0.0, 1.0, np.nan)
    ]
    assert found[0] == found[1] == found[2]
    assert found[0].bias == {"q", "params"}


@pytest.mark.parametrize(
    ("name", "mass", "bias", "time"),
    [
        ("mass_spring", {"params"}, {"q", "params"}, False),
        ("two_mass_three_springs", {"params"}, {"q", "params"}, False),
        ("simple_pendulum", {"params"}, {"q", "params"}, False),
        ("double_pendulum", {"q", "params"}, {"q", "v", "params"}, False),
        ("cart_pendulum", {"q", "params"}, {"q", "v", "params"}, False),
        ("chain", {"q", "params"}, {"q", "v", "params"}, False),
        ("charged", {"params"}, {"v", "params"}, False),
        ("driven_pivot", {"q", "params"}, {"t", "q", "v", "params"}, True),
        ("bead", {"t", "q", "params"}, {"t", "q", "v", "params"}, True),
        ("relativistic", {"v", "params"}, {"params"}, False),
    ],
)
def test_dependencies_are_those_of_the_equations(name, mass, bias, time):
    """Or those of the program if only algebra cancels them: cos^2 + sin^2 in driven_pivot."""
    found = of(name)
    assert (found.mass, found.explicit_time) == (mass, time)
    assert (found.bias, found.bias_zero) == (bias, False)


PLAIN = "cart_pendulum", "quadcopter", "rolling_disk", "falling_stick_friction", *GENERAL


@pytest.mark.parametrize("name", mostly_full([*ENTRIES, *GENERAL], *PLAIN))
def test_terms_do_not_change_with_unlisted_arguments(name):
    """Soundness in numbers: a change of an unlisted argument changes no bit of a term."""
    case = ENTRIES[name].example if name in ENTRIES else GENERAL[name]
    system = ENTRIES[name].system if name in ENTRIES else GENERAL[name].system
    found, params, n = of(name), dict(case.params), system.size
    state = {"t": jnp.array(0.3), "q": jnp.linspace(0.2, 0.7, n), "v": jnp.linspace(0.5, 1.0, n)}

    @jax.jit
    def terms(t, q, v):
        M = system.mass_matrix(q, v, params, t=t)
        return {"mass": M, "bias": system.bias(q, v, params, t=t)}

    before = terms(**state)
    for argument, value in state.items():
        after = terms(**(state | {argument: value + 0.37}))
        for term in ("mass", "bias"):
            if argument not in getattr(found, term):
                np.testing.assert_array_equal(before[term], after[term])


# ---- Ways of writing a quadratic energy ----------------------------------------------------------

FORMS = {
    "v @ v": lambda t, q, v, params: 0.5 * v @ v,
    "sum v**2": lambda t, q, v, params: 0.5 * jnp.sum(v**2),
    "sum v**1 v": lambda t, q, v, params: 0.5 * jnp.sum(v**1 * v),
    "sum v*v": lambda t, q, v, params: 0.5 * jnp.sum(v * v),
    "square": lambda t, q, v, params: 0.5 * jnp.sum(jnp.square(v)),
    "entries": lambda t, q, v, params: 0.5 * (v[0] ** 2 + v[1] * v[1]),
    "unpacked": lambda t, q, v, params: 0.5 * (lambda a, b: a**2 + b**2)(*v),
    "dot": lambda t, q, v, params: 0.5 * jnp.dot(v, jnp.eye(2) @ v),
    "einsum": lambda t, q, v, params: 0.5 * jnp.einsum("i,ij,j", v, jnp.eye(2), v),
    "vdot": lambda t, q, v, params: 0.5 * jnp.vdot(v, v),
    "jit": lambda t, q, v, params: 0.5 * jax.jit(lambda v: v @ v)(v),
    "checkpoint": lambda t, q, v, params: 0.5 * jax.checkpoint(lambda v: v @ v)(v),
    "vmap": lambda t, q, v, params: 0.5 * jnp.sum(jax.vmap(lambda x: x**2)(v)),
    "derivative": lambda t, q, v, params: (
        0.5 * jnp.sum(jax.jvp(lambda x: 1.0 * x, (q,), (v,))[1] ** 2)
    ),
    "shifted": lambda t, q, v, params: 0.5 * v @ v + v[0] + 1.0,
}

LOOPS = {
    "v**2.0": lambda t, q, v, params: 0.5 * jnp.sum(v**2.0),
    "loop": lambda t, q, v, params: 0.5 * jax.lax.fori_loop(0, 2, lambda i, T: T + v[i] ** 2, 0.0),
    "scan": lambda t, q, v, params: (
        0.5 * jax.lax.scan(lambda T, x: (T + x**2, None), jnp.zeros(()), v)[0]
    ),
    "rows of a scan": lambda t, q, v, params: (
        0.5 * jnp.sum(jax.lax.scan(lambda k, x: (2 * k, x**2), 1.0, v)[1])
    ),
    "cond on a constant": lambda t, q, v, params: jax.lax.cond(
        jnp.asarray(True), lambda v: v @ v, lambda v: 2 * v @ v, v
    ),
}


@pytest.mark.parametrize("form", LOOPS)
def test_quadratic_kinetic_energy_is_detected_through_loops(form):
    found = structure(LOOPS[form])
    assert found.quadratic
    assert found.mass_constant


@pytest.mark.parametrize("form", FORMS)
def test_quadratic_kinetic_energy_is_detected_in_any_form(form):
    found = structure(FORMS[form])
    assert found.quadratic
    assert found.mass_constant
    assert found.bias_zero


@pytest.mark.parametrize(
    "lagrangian",
    [
        lambda t, q, v, params: 0.5 * v @ v + v[0] ** 4,
        lambda t, q, v, params: 0.5 * v @ v + v[0] ** 3,
        lambda t, q, v, params: -jnp.sqrt(1 - v @ v),
        lambda t, q, v, params: jnp.cosh(v[0]) + jnp.cosh(v[1]),
        lambda t, q, v, params: 0.5 * jnp.where(v[0] > 0, 1.0, 2.0) * v @ v,
    ],
    ids=["fourth", "third", "sqrt", "cosh", "where"],
)
def test_energies_that_are_not_quadratic_are_detected(lagrangian):
    found = structure(lagrangian)
    assert "v" in found.mass
    assert not found.quadratic
    assert not found.mass_constant


def test_powers_that_are_not_quadratic_are_detected():
    """The second derivative of v**1.0 is 0 * v**-1: NaN at rest, so that M is not taken there."""
    for power in (1.0, 2.5, 3.0, -1.0):
        found = structure(lambda t, q, v, params, k=power: 0.5 * v @ v + jnp.sum(v**k))
        assert not found.quadratic
    found = structure(lambda t, q, v, params: 0.5 * jnp.sum(v ** (2.0 + 0.0 * q[0])))
    assert "v" in found.mass


def dependences(function, **arguments):
    """Arguments on which each output of a function depends, as strings of their names."""
    jaxpr = jax.make_jaxpr(function)(*arguments.values()).jaxpr
    found = outputs_depend_on(jaxpr, [frozenset({name}) for name in arguments])
    return ["".join(sorted(names)) for names in found]


def test_dependence_is_followed_through_all_iterations_of_a_loop():
    """a -> b -> c -> d takes three iterations; e passes through; outputs depend on the carries."""

    def body(carry, x):
        a, b, c, d, e = carry
        return (a, a * b, b, c, e), (x + d, e)

    def function(a, b, c, d, e, xs):
        return jax.lax.scan(body, (a, b, c, d, e), xs)

    found = dependences(function, a=1.0, b=1.0, c=1.0, d=1.0, e=1.0, r=jnp.ones(9))
    assert found == ["a", "ab", "abc", "abcd", "e", "abcdr", "e"]
    once = dependences(lambda a, k: jax.lax.scan(lambda x, _: (k * x, k), a, None, 3), a=1.0, k=2.0)
    assert once == ["ak", "k"]


def test_dependence_of_a_while_loop_includes_its_condition():
    """Variables that decide the number of iterations affect only what the iterations change."""

    def function(limit, x, y, k):
        def body(carry):
            i, x, y = carry
            return i + 1.0, k * x, y

        return jax.lax.while_loop(lambda carry: carry[0] < limit, body, (0.0, x, y))

    assert dependences(function, l=1.0, x=1.0, y=1.0, k=2.0) == ["l", "klx", "y"]

    def until_met(x, y):
        return jax.lax.while_loop(lambda c: c[0] < 9.0, lambda c: (c[0] + 1, 2 * c[1]), (x, y))

    assert dependences(until_met, x=1.0, y=1.0) == ["x", "xy"]

    def late(x, y, z):
        """The condition reads y from the second iteration on."""
        return jax.lax.while_loop(lambda c: c[0] < 9.0, lambda c: (c[1], c[1], c[2] + 1), (x, y, z))

    assert dependences(late, x=1.0, y=1.0, z=1.0) == ["xy", "y", "xyz"]


def test_dependence_of_a_choice_includes_every_branch_and_the_index():
    def function(k, x, y, z):
        branches = [lambda x, y, z: (x, z), lambda x, y, z: (y, z), lambda x, y, z: (1.0, 2 * z)]
        return jax.lax.switch(k, branches, x, y, z)

    assert dependences(function, k=1, x=1.0, y=1.0, z=1.0) == ["kxy", "kz"]
    nested = dependences(
        lambda n, x: jax.lax.fori_loop(
            0, n, lambda i, x: jax.lax.cond(i > 1, lambda: x, lambda: 2 * x), x
        ),
        n=3,
        x=1.0,
    )
    assert nested == ["nx"]


def test_control_flow_hides_no_dependence():
    """Reads inside cond, scan and while count."""

    def choose(t, q, v, params):
        return jax.lax.cond(t > 1.0, lambda: 1.0 + q[0] ** 2, lambda: 2.0 + q[0] ** 2) * v @ v

    def power(t, q, v, params):
        return jax.lax.fori_loop(0, 2, lambda _, x: x * q[0], jnp.ones(())) * v @ v

    assert structure(choose).mass >= {"t", "q"}
    assert structure(power).mass >= {"q"}
    assert structure(power).bias >= {"q", "v"}


def test_custom_rules_are_followed():
    """A function with a custom derivative depends on what that derivative reads."""

    @jax.custom_jvp
    def mass(x):
        return 1.0 + 0.0 * x

    @mass.defjvp
    def _(primals, tangents):
        return mass(primals[0]), primals[0] * tangents[0]

    found = structure(lambda t, q, v, params: 0.5 * mass(q[0]) * v @ v)
    assert (found.mass >= {"q"}, found.bias >= {"q", "v"}) == (True, True)


def test_dependence_is_traced_per_argument():
    """The search itself, on functions of (t, q, v, params)."""
    state = (jnp.zeros(()), jnp.zeros(2), jnp.zeros(2))

    def nothing(t, q, v, params):
        return jnp.ones(3)

    def all_of_it(t, q, v, params):
        return t + q[0] * v[1] + params

    found = find_structure(nothing, all_of_it, lambda t, q, v, params: q, state, jnp.ones(()))
    assert found.mass == frozenset()
    assert found.bias == {"t", "q", "v", "params"}
    assert found.lagrangian == {"q"}
    assert not found.bias_zero


# ---- Caching -------------------------------------------------------------------------------------


def test_structure_is_traced_once_per_kind_of_params():
    traces = []

    def lagrangian(t, q, v, params):
        traces.append(params)
        return 0.5 * params["m"] * v @ v

    system = jl.System(lagrangian, PAIR)
    system._structure({"m": 1.0}, jnp.float64)
    first = len(traces)
    system._structure({"m": 7.0}, jnp.float64)
    jl.System(lagrangian, PAIR)._structure({"m": 3.0}, jnp.float64)
    assert len(traces) == first > 0
    system._structure({"m": 2}, jnp.float64)  # static: another program
    assert len(traces) > first


def test_python_numbers_take_the_precision_of_the_state():
    """Weakly typed in the structure as in the program: strict JAX refuses no promotion."""
    system = jl.System(lambda t, q, v, params: 0.5 * params["m"] * v @ v, PAIR)
    assert system._structure({"m": 2.0}, jnp.float32).quadratic
    M = system.mass_matrix(np.zeros(2, np.float32), params={"m": 2.0})
    np.testing.assert_array_equal(M, 2 * np.eye(2, dtype=np.float32))
    assert M.dtype == jnp.float32


# ---- Explain -------------------------------------------------------------------------------------


def explained_lines(name):
    """The lines of `explain`, with single blanks."""
    system, params = (
        (ENTRIES[name].system, dict(ENTRIES[name].example.params))
        if name in ENTRIES
        else GENERAL[name][:2]
    )
    lines = system.explain(params).splitlines()
    return [" ".join(line.split()) for line in lines]


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("mass_spring", "lagrangian depends on q, v, params; no explicit time"),
        ("mass_spring", "mass matrix depends on params"),
        ("mass_spring", "bias depends on q, params"),
        ("double_pendulum", "mass matrix depends on q, params"),
        ("double_pendulum", "bias depends on q, v, params"),
        ("double_pendulum", "forces none, so no force code is compiled"),
        ("driven_pivot", "lagrangian depends on t, q, v, params; explicit time"),
        ("relativistic", "mass matrix depends on v, params"),
        ("cart_pendulum", "coordinates 2: x, theta"),
        (
            "cart_pendulum",
            "forces cart (GeneralizedForce), rod end (GeneralizedForce), damper (Rayleigh)",
        ),
        ("chain", "coordinates 3: theta[0], theta[1], theta[2]"),
    ],
)
def test_explain_states_what_was_found(name, line):
    assert [found for found in explained_lines(name) if found.startswith(line)] != []


def test_explain_states_absent_dependencies():
    lines = jl.System(lambda t, q, v, params: 0.5 * v @ v, PAIR).explain(None).splitlines()
    assert "mass matrix   depends on nothing" in lines
    assert "bias          zero" in lines


def test_explain_states_how_the_mass_matrix_is_solved():
    for n, algorithm in (
        (8, "unrolled"),
        (9, "in a loop over pivots (n > 8)"),
        (17, "by library Cholesky (n > 16)"),
    ):
        explained = chain(n, lowering="array").explain(GENERAL["chain"].params)
        assert f"mass solve    one factorization per evaluation, {algorithm}" in explained


def test_explain_states_that_a_constant_mass_matrix_is_factored_once():
    system = jl.System(lambda t, q, v, params: 0.5 * v @ v, PAIR, lowering="array")
    explained = system.explain(None)
    assert "mass solve    one factorization once per solve, unrolled" in explained
    assert "h by" not in explained


def test_explain_refuses_vector_valued_lagrangians():
    system = jl.System(lambda t, q, v, params: 0.5 * v**2, PAIR)
    with pytest.raises(
        ValueError, match=r"^`lagrangian` must return a real scalar, but it returned "
    ):
        system.explain(None)
