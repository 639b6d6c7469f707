"""Custom derivative rules survive every transform, up to second derivatives.

The rule of `sine` differs from the derivative of its body: f' = 2 f, so that f'' = 4 f. A transform
that drops the rule gives -f.
"""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag._core._custom_jvp import CustomJVP, keeping_rules

X = 0.3
LOOPS = {
    "scan": lambda f: lambda x: jax.lax.scan(lambda c, _: (f(c), None), x, None, length=1)[0],
    "map": lambda f: lambda x: jax.lax.map(f, x[None])[0],
    "fori_loop": lambda f: lambda x: jax.lax.fori_loop(0, 1, lambda _, c: f(c), x),
    "cond": lambda f: lambda x: jax.lax.cond(x > 0, f, lambda x: x, x),
    "checkpoint": jax.checkpoint,
    "vmap": lambda f: lambda x: jax.vmap(f)(x[None])[0],
    "jit": jax.jit,
}
DERIVATIVES = {
    "jvp": lambda f: lambda x: jax.jvp(f, (x,), (jnp.ones_like(x),))[1],
    "grad": jax.grad,
    "jacfwd": jax.jacfwd,
    "jacrev": jax.jacrev,
}
PAIRS = list(itertools.product(DERIVATIVES, DERIVATIVES))


def twice(pair, f):
    outer, inner = pair
    return DERIVATIVES[outer](DERIVATIVES[inner](f))


@CustomJVP
def sine(x):
    return jnp.sin(x)


@sine.defjvp
def _(primals, tangents):
    return sine(*primals), 2.0 * sine(*primals) * tangents[0]


@jax.custom_jvp
def users(x):
    return jnp.sin(x)


@users.defjvp
def _(primals, tangents):
    return users(*primals), 2.0 * users(*primals) * tangents[0]


def of_pairs(fs, pairs):
    """All second derivatives at X, by one compiled program."""
    found = jax.jit(lambda x: [twice(pair, f)(x) for f in fs for pair in pairs])(jnp.asarray(X))
    return dict(zip(itertools.product(range(len(fs)), pairs), map(float, found), strict=True))


@pytest.mark.full
@pytest.mark.parametrize("loop", LOOPS)
def test_rules_survive_loops(loop):
    """Rules of `CustomJVP`, and of `jax.custom_jvp` under `keeping_rules`."""
    found = of_pairs([LOOPS[loop](f) for f in (sine, keeping_rules(users))], PAIRS)
    wanted = 4 * np.sin(X)
    assert not {pair: x for pair, x in found.items() if abs(x - wanted) > 1e-15}


@pytest.mark.full
@pytest.mark.parametrize("outer", LOOPS)
def test_rules_survive_loops_within_loops(outer):
    inner = [LOOPS[outer](LOOPS[inner](sine)) for inner in LOOPS]
    found = of_pairs(inner, [("jvp", "grad"), ("grad", "grad")])
    wanted = 4 * np.sin(X)
    assert not {pair: x for pair, x in found.items() if abs(x - wanted) > 1e-15}


@CustomJVP
def quotient(x, y):
    return x / y


@quotient.defjvp
def _(primals, tangents):
    """Calls the function itself on tangents, in which it is linear."""
    (_, y), (dx, dy) = primals, tangents
    z = quotient(*primals)
    return z, quotient(dx - z * dy, y)


@pytest.mark.full
@pytest.mark.parametrize("loop", ["fori_loop", "jit", "checkpoint", "vmap"])
@pytest.mark.parametrize("mode", ["grad", "jacrev"])
def test_rules_may_call_functions_linear_in_tangents(mode, loop):
    """Reverse derivatives transpose such a call: of 1 / (1 + x^2), first and second order."""

    def f(x):
        return quotient(jnp.ones_like(x), 1.0 + x * x)

    looped, s = LOOPS[loop](f), 1.0 + X * X
    x = jnp.asarray(X)
    np.testing.assert_allclose(DERIVATIVES[mode](looped)(x), -2.0 * X / s**2, rtol=1e-14)
    second = (6.0 * X**2 - 2.0) / s**3
    for pair in ((mode, "grad"), (mode, "jacfwd"), ("jacfwd", mode)):
        np.testing.assert_allclose(twice(pair, looped)(x), second, rtol=1e-13)


@pytest.mark.full
def test_float32_derivatives_in_loops_equal_float64():
    """Equations with a division, compared with double precision."""
    system = jl.System(
        lambda t, q, v, p: 0.5 * v[0] ** 2 * (1 + q[0] ** 2) + jnp.cos(p * q[0]), ("x",)
    )

    def end(p):
        def step(_, x):
            a = system.acceleration(x[:1], x[1:], p)
            return x + 0.01 * jnp.concatenate([x[1:], a])

        return jnp.sum(jax.lax.fori_loop(0, 3, step, jnp.ones(2, p.dtype)))

    for derivative in (jax.grad(end), jax.jacfwd(jax.grad(end)), jax.grad(jax.grad(end))):
        one, other = (derivative(jnp.asarray(1.3, dtype)) for dtype in (jnp.float32, jnp.float64))
        assert abs(float(one) - float(other)) <= 32 * float(jnp.finfo(jnp.float32).eps) * 0.02


def test_jax_loops_may_drop_custom_jvp_rules():
    """The reason for a primitive, until all supported versions of JAX keep such rules."""
    found = jax.jvp(jax.grad(LOOPS["scan"](users)), (X,), (1.0,))[1]
    assert np.isclose(found, 4 * np.sin(X)) or np.isclose(found, 2 * np.cos(X))


@CustomJVP
def scaled(tree, count, factor):
    """A function of a dict, an integer and a number."""
    return {"sum": jnp.sum(tree["x"]) * factor, "count": count + 1}, tree["x"] * factor


SEEN = []


def scaled_rule(primals, tangents):
    tree, _, factor = primals
    SEEN.append(jax.tree.map(lambda x: x is not None, tangents, is_leaf=lambda x: x is None))
    dot = jnp.zeros_like(tree["x"]) if tangents[0]["x"] is None else tangents[0]["x"]
    moved = 0.0 if tangents[2] is None else tangents[2]
    products = dot * factor + tree["x"] * moved
    return scaled(*primals), ({"sum": 10.0 * jnp.sum(products), "count": None}, products)


scaled.defjvp(scaled_rule, symbolic_zeros=True)


def test_rules_accept_trees_integers_and_zero_tangents():
    x = jnp.array([1.0, 2.0])

    def total(x, factor):
        sums, products = scaled({"x": x}, jnp.asarray(3), factor)
        return sums["sum"] + products[0]

    SEEN.clear()
    np.testing.assert_allclose(jax.grad(total)(x, 5.0), [55.0, 50.0])
    assert SEEN == [({"x": True}, False, False)]
    np.testing.assert_allclose(jax.grad(total, argnums=1)(x, 5.0), 31.0)
    assert SEEN[1] == ({"x": False}, False, True)
    np.testing.assert_allclose(jax.jit(jax.grad(total, argnums=1))(x, 5.0), 31.0)
    assert jax.jit(lambda x: scaled({"x": x}, jnp.asarray(3), 5.0)[0]["count"])(x) == 4


@pytest.mark.parametrize("axes", [(0, None), (None, 0), (0, 0)])
def test_vmap_over_some_arguments_equals_single_calls(axes):
    x, factor = jnp.arange(6.0).reshape(3, 2), jnp.array([2.0, 3.0, 5.0])
    given = x if axes[0] == 0 else x[0], factor if axes[1] == 0 else factor[0]

    def total(x, factor):
        sums, products = scaled({"x": x}, jnp.asarray(3), factor)
        return sums["sum"] + products[0]

    for derivative in (jax.grad, jax.jacfwd):
        by = derivative(total, argnums=(0, 1))
        found = jax.jit(jax.vmap(by, axes))(*given)
        single = [
            by(given[0][i] if axes[0] == 0 else given[0], given[1][i] if axes[1] == 0 else given[1])
            for i in range(3)
        ]
        for k in (0, 1):
            np.testing.assert_allclose(found[k], jnp.stack([gradient[k] for gradient in single]))
    # The derivative of the batch, not the batch of derivatives.
    whole = jax.jit(jax.jacrev(lambda *given: jax.vmap(total, axes)(*given), argnums=(0, 1)))
    jac = whole(*given)[0]
    for i in range(3):
        gradient = jac[i, i] if axes[0] == 0 else jac[i]
        expected = jax.grad(total)(
            given[0][i] if axes[0] == 0 else given[0], given[1][i] if axes[1] == 0 else given[1]
        )
        np.testing.assert_allclose(gradient, expected)


def test_calls_on_numbers_are_not_traced():
    """Nothing is traced if nothing is differentiated."""
    calls = []

    @CustomJVP
    def seen(x):
        calls.append(x)
        return x * x

    seen.defjvp(lambda p, t: (seen(*p), 3.0 * t[0]))
    assert seen(2.0) == 4.0
    assert calls == [2.0]
    assert jax.grad(seen)(2.0) == 3.0
    with jax.disable_jit():
        assert jax.grad(seen)(2.0) == 3.0


def test_nested_rules_survive_loops():
    """The rule of the outer function calls a function with a rule by `jax.custom_jvp`."""

    @jax.custom_jvp
    def outer(x):
        return x

    @outer.defjvp
    def _(primals, tangents):
        return outer(*primals), users(*primals) * tangents[0]

    looped = LOOPS["scan"](keeping_rules(outer))
    first = jax.grad(looped)(X)
    second = jax.jvp(jax.grad(looped), (X,), (1.0,))[1]
    third = jax.grad(lambda x: jax.jvp(jax.grad(looped), (x,), (1.0,))[1])(X)
    np.testing.assert_allclose([first, second, third], np.array([1, 2, 4]) * np.sin(X), rtol=1e-15)


# ---- Derivatives of jaxlag's functions in loops --------------------------------------------------


def pendulum(function, lowering="auto"):
    def lagrangian(t, q, v, params):
        return 0.5 * v[0] ** 2 + params[0] * jnp.cos(q[0]) + params[1] * function(q[0])

    return jl.System(lagrangian, ("angle",), lowering=lowering)


rod = jl.System(
    lambda t, q, v, params: 0.5 * v @ v + params[0] * q[0] + params[1] * users(q[1]),
    ("x", "y"),
    constraints=(jl.Holonomic(lambda t, q, params: q @ q - 1.0, "rod"),),
    lowering="array",  # scalar programs of second derivatives take minutes to compile
)
PARAMS, STARTS = jnp.array([1.3, 0.4]), jnp.array([0.3, 0.8])


def end(system, **options):
    def angle(start, params):
        motion = jl.simulate(system, [start], [0.0], [0.0, 1.0], params, **options)
        return motion["angle"][-1]

    return angle


pulled = jl.System(
    lambda t, q, v, p: 0.5 * v[0] ** 2 - 0.5 * p[0] * q[0] ** 2 + p[1] * jnp.sin(q[0] + 1.0), ("x",)
)


def resting(start, params):
    return start * jl.equilibrium(pulled, [start], params).q[0]


def assembled(start, params):
    q = jnp.stack([jnp.sin(start), params[0] * jnp.cos(start)])
    return jl.assemble(rod, q, jnp.zeros(2), params=params).q[0] * params[1] ** 2


def swung(start, params):
    q = jnp.stack([jnp.sin(start), jnp.cos(start)])
    options = {"method": "bosh3", "dt": 0.1}
    return jl.simulate(rod, q, [0.0, 0.0], [0.0, 0.5], params, **options)["x"][-1]


def accelerated(start, params):
    q = (start * params[0])[None]
    return pendulum(users).acceleration(q, jnp.ones(1), params**2)[0]


def lengths(start, params):
    x = jnp.stack([start * params[0], params[1]])
    return jl.math.norm(x) + params[1] ** 2 * jl.math.sinc(1e-3 * x[0]) + jl.math.unit(x)[1]


CHEAP = {"accelerated": accelerated, "lengths": lengths, "assembled": assembled}
CHEAP |= {"resting": resting}
MOTIONS = {
    "auto": end(pendulum(users)),
    "array": end(pendulum(users, "array")),
    "constrained": swung,
    "fixed": end(pendulum(users), method="dopri5", dt=0.1),
    "gauss4": end(pendulum(users), method="gauss4", dt=0.1),
    "implicit": end(pendulum(users), method="kvaerno5"),
    "implicit fixed": end(pendulum(users), method="implicit_euler", dt=0.1),
    "variational2": end(pendulum(users), method="variational2", dt=0.1),
    "splitting4": end(pendulum(users), method="splitting4", dt=0.1),
}
AROUND = {
    "scan": lambda f, w: jax.lax.scan(lambda c, q: (c + f(q, w), None), 0.0 * w[0], STARTS)[0],
    "map": lambda f, w: jax.lax.map(lambda q: f(q, w), STARTS).sum(),
    "fori_loop": lambda f, w: jax.lax.fori_loop(0, 2, lambda i, c: c + f(STARTS[i], w), 0.0 * w[0]),
    "vmap": lambda f, w: jax.vmap(lambda q: f(q, w))(STARTS).sum(),
    "cond": lambda f, w: sum(
        jax.lax.cond(q < w[0], lambda q: f(q, w), lambda q: q, q) for q in STARTS
    ),
    "checkpoint": lambda f, w: sum(jax.checkpoint(f)(q, w) for q in STARTS),
    "map of checkpoint": lambda f, w: jax.lax.map(jax.checkpoint(lambda q: f(q, w)), STARTS).sum(),
    "checkpoint of map": lambda f, w: jax.checkpoint(AROUND["map"], static_argnums=0)(f, w),
    "vmap of scan": lambda f, w: jax.vmap(
        lambda q: jax.lax.scan(lambda c, k: (c + f(q, k * w), None), 0.0 * w[0], jnp.ones(1))[0]
    )(STARTS).sum(),
    "scan of vmap": lambda f, w: jax.lax.scan(
        lambda c, k: (c + AROUND["vmap"](f, k * w), None), 0.0 * w[0], jnp.ones(1)
    )[0],
    "vmap of cond": lambda f, w: jax.vmap(
        lambda q: jax.lax.cond(q < w[0], lambda q: f(q, w), lambda q: q, q)
    )(STARTS).sum(),
}


def matrix(derivative):
    """Maps a function of params to the function that returns its gradient or Jacobian."""
    if derivative == "jvp":
        return lambda f: lambda w: jnp.stack([jax.jvp(f, (w,), (e,))[1] for e in jnp.eye(2)], -1)
    if derivative == "grad":

        def by_grad(f):
            def of(w):
                if jax.eval_shape(f, w).shape == ():
                    return jax.grad(f)(w)
                return jnp.stack([jax.grad(lambda w, i=i: f(w)[i])(w) for i in range(2)])

            return of

        return by_grad
    return DERIVATIVES[derivative]


def hessian_of(function):
    """Second derivatives without a loop, where no rule is dropped."""

    def total(w):
        return function(STARTS[0], w) + function(STARTS[1], w)

    return jax.hessian(total), jax.jacfwd(jax.jacfwd(total))


def check(function, loops, pairs, rtol):
    """All in one program; the reference is forward over forward without a loop."""
    chosen = list(itertools.product(loops, pairs))
    ways = [
        matrix(outer)(matrix(inner)(eqx.Partial(AROUND[loop], function)))
        for loop, (outer, inner) in chosen
    ]
    by = jax.jit(lambda w: [way(w) for way in (*ways, *hessian_of(function))])
    *found, reverse, wanted = by(PARAMS)
    scale = jnp.max(jnp.abs(wanted))
    for name, x in zip([*chosen, "no loop"], [*found, reverse], strict=True):
        assert jnp.max(jnp.abs(x - wanted)) <= rtol * scale, (name, x, wanted)


@pytest.mark.full
@pytest.mark.parametrize("name", CHEAP)
def test_second_derivatives_of_values_are_right_in_loops(name):
    check(CHEAP[name], ["map"], [("jvp", "grad"), ("grad", "grad")], 1e-10)


def check_motion(angle, rtol):
    """By one parameter, also without a loop by the user: the loop over steps drops no rule."""

    def alone(w):
        return angle(0.3, jnp.stack([1.3, w]))

    def looped(w):
        return jax.lax.map(lambda start: angle(start, jnp.stack([1.3, w])), jnp.array([0.3]))[0]

    def jvp(f):
        return lambda w: jax.jvp(f, (w,), (1.0,))[1]

    ways = [jvp(jax.grad(looped)), jvp(jax.grad(alone)), jvp(jvp(alone))]
    *found, wanted = jax.jit(lambda w: [way(w) for way in ways])(0.4)
    np.testing.assert_allclose(found, wanted, rtol=rtol)


@pytest.mark.full
@pytest.mark.parametrize("lowering", ["auto", "array"])
def test_second_derivatives_of_motions_are_right_in_loops(lowering):
    check_motion(end(pendulum(users, lowering), method="bosh3", dt=0.25), 1e-13)


# A program of all pairs takes half a minute to compile if it contains a search or a solve: these
# are checked in loops within others and in a branch.
NESTED = ["checkpoint of map", "vmap of scan", "vmap of cond"]


@pytest.mark.full
@pytest.mark.parametrize(
    ("name", "loop"),
    [
        *itertools.product(["accelerated"], ["scan", "fori_loop", "cond", *NESTED]),
        ("lengths", "scan"),
        ("lengths", "vmap of cond"),
    ],
)
def test_all_pairs_of_modes_agree_on_values(name, loop):
    check(CHEAP[name], [loop], PAIRS, 1e-10)


@pytest.mark.full
@pytest.mark.parametrize(
    ("name", "loop"), [*zip(["assembled", "resting", "assembled"], NESTED, strict=True)]
)
def test_all_pairs_of_modes_agree_on_searches(name, loop):
    check(CHEAP[name], [loop], PAIRS, 1e-10)


@pytest.mark.full
@pytest.mark.parametrize("loop", NESTED[1:2])
def test_all_pairs_of_modes_agree_on_motions(loop):
    check(MOTIONS["auto"], [loop], PAIRS, 1e-7)


@pytest.mark.full
@pytest.mark.parametrize("name", [name for name in MOTIONS if name != "auto"])
def test_second_derivatives_are_right_for_all_methods(name):
    check_motion(MOTIONS[name], 1e-7)
