"""Nystrom's method of order 12: conditions of order, forms of a step, motions, refusals."""

from functools import cache
from itertools import pairwise

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag.solvers._explicit import tableau_of
from jaxlag.solvers._unweighted_stages import unweighted_stages

EPS = np.finfo(float).eps
NYSTROM = jl.solvers.Nystrom12()


# ---- Conditions of order: Hairer, Norsett, Wanner I, sec. II.14, for q'' = f(q) --------------


@cache
def trees(order):
    """(m, branches): an elementary differential of f, m of its arguments v, the others branches.

    Its change of v is of that order in h, that of q of the next one.
    """

    def forests(left, largest):
        if left == 0:
            yield ()
            return
        for size in range(min(left - 1, largest[0]), 0, -1):
            for index, tree in enumerate(trees(size)):
                if (size, index) <= largest:
                    for rest in forests(left - size - 1, (size, index)):
                        yield (tree, *rest)

    top = order, 10**9
    return [(m, found) for m in range(order) for found in forests(order - 1 - m, top)]


def weight(tree, A, c):
    """(stage values, h^(1 - order) times f of the exact solution, order)."""
    m, branches = tree
    parts = [weight(branch, A, c) for branch in branches]
    values = np.prod([c**m, *(A @ part[0] for part in parts)], axis=0)
    exact = np.prod([x / (n * (n + 1)) for _, x, n in parts])
    return values, exact, 1 + m + sum(n + 1 for _, _, n in parts)


def defects(A, c, b, order):
    """Largest violations of the conditions for v of that order, and for q of the next one."""
    found = [weight(tree, A, c) for tree in trees(order)]
    of_v = max(abs(b @ values - exact / n) for values, exact, n in found)
    rest = (1 - c) * b
    return of_v, max(abs(rest @ values - exact / (n * (n + 1))) for values, exact, n in found)


def coefficients():
    tableau = tableau_of(type(NYSTROM))
    A = np.concatenate([np.zeros((1, 17)), tableau.rows_squared])
    return A, np.array([0.0, *tableau.c]), tableau.b, tableau.b - tableau.e


def worst(A, c, b, order):
    """Over all conditions up to that order of v and of q."""
    found = [defects(A, c, b, n) for n in range(1, order + 1)]
    return max(*(v for v, _ in found), *(q for _, q in found[:-1]))


def test_coefficients_satisfy_the_conditions_of_order_12_and_10_and_no_more():
    A, c, b, lower = coefficients()
    assert [len(trees(n)) for n in (1, 2, 3, 4, 5, 6, 7)] == [1, 1, 2, 3, 6, 10, 20]
    rounding = 1e2 * EPS  # stages times weights; measured 3e-17 and 1e-16
    assert worst(A, c, b, 12) < rounding
    assert worst(A, c, lower, 10) < rounding
    assert max(defects(A, c, b, 13)) > 1e3 * rounding
    assert max(defects(A, c, lower, 11)) > 1e3 * rounding
    wrong = A.copy()
    wrong[-2, 0] *= 1 + 1e-9
    assert worst(wrong, c, b, 12) > rounding


# ---- One step --------------------------------------------------------------------------------


class Coupled(diffrax.ODETerm):
    """Two coupled pendulums with a force of time, y = (q, v) a vector; also backward in time."""

    in_lanes: bool
    time_direction: float
    second_order: bool = True

    def __init__(self, in_lanes, time_direction):
        def field(t, y, args):
            q, v = y[:2], y[2:]
            a = args * jnp.cos(t) - jnp.sin(q) + 0.4 * jnp.sum(q) ** 3
            return time_direction * jnp.concatenate([v, a])

        super().__init__(field)
        self.in_lanes, self.time_direction = in_lanes, time_direction

    def sections(self, y):
        return y[:2], y[2:], y[4:]

    def signed(self, x, args):
        return jax.tree.map(lambda x: self.time_direction * x, x)


def by_hand(term, t0, t1, y0, args):
    """(y1, error, stages) from the formulas, with the coefficients of the paper."""
    A, c, b, lower = coefficients()
    h, sign = t1 - t0, term.time_direction
    q, v = y0[:2], y0[2:]
    k = np.zeros((17, 2))
    for i in range(17):
        stage = q + sign * h * c[i] * v + h**2 * A[i] @ (sign * k)
        k[i] = term.vf(t0 + c[i] * h, jnp.concatenate([jnp.asarray(stage), v]), args)[2:]

    def end(b):
        rest = (1 - c) * b
        return np.concatenate([q + sign * (h * v + h**2 * rest @ k), v + h * b @ k])

    return end(b), end(b) - end(lower), k


@pytest.mark.parametrize("time_direction", [1.0, -1.0], ids=["onwards", "backwards"])
@pytest.mark.parametrize("in_lanes", [True, False], ids=["lanes", "alone"])
@pytest.mark.parametrize("looped", [True, False], ids=["in_a_loop", "written_out"])
def test_a_step_is_that_of_the_formulas(looped, in_lanes, time_direction):
    """To rounding of the largest sum, which has coefficients of up to 17 h^2."""
    y0 = np.random.default_rng(2).uniform(-1.5, 1.5, (3, 4))
    t0, t1, push = jnp.array(0.3), jnp.array(0.95), jnp.array(0.3)
    term, solver = Coupled(in_lanes and not looped, time_direction), jl.solvers.Nystrom12(looped)

    def step(y0):
        y1, error, dense, last, _ = solver.step(term, t0, t1, y0, push, None, made_jump=False)
        assert last is None
        return y1, error, dense["k"]

    y1, error, k = jax.jit(jax.vmap(step))(jnp.asarray(y0))
    for lane in range(3):
        exact, estimate, stages = by_hand(Coupled(False, time_direction), t0, t1, y0[lane], push)
        bound = 32 * EPS * 17
        np.testing.assert_allclose(y1[lane], exact, rtol=0, atol=bound)
        np.testing.assert_allclose(error[lane], estimate, rtol=0, atol=bound)
        np.testing.assert_allclose(k[lane][:, 2:], (t1 - t0) * stages, rtol=0, atol=bound)
        rates = (t1 - t0) * time_direction * exact[2:]  # at the end of the step
        np.testing.assert_allclose(k[lane][-1, :2], rates, rtol=0, atol=bound)


def test_stages_have_no_velocities():
    """No sums for them: with v unknown all stages, and the change of v, are as before."""

    def changes(v):
        def field(t, y, args):
            return (y[1], -jnp.sin(y[0]))

        given = jnp.array(0.0), jnp.array(0.5), (jnp.array(1.0), v), None
        return NYSTROM.step(diffrax.ODETerm(field), *given, None, made_jump=False)[0]

    moving = jax.make_jaxpr(changes)(jnp.array(0.2))
    assert str(moving).count("= sin ") == 17
    A, _, b, _ = coefficients()
    # Products of coefficients: those of A, of b for v and for q, and of c and h.
    most = np.count_nonzero(A) + 4 * np.count_nonzero(b) + 8 * 17
    assert str(moving).count("= mul ") < most


def test_stages_without_weight():
    tableau = tableau_of(type(NYSTROM))
    assert tableau.unweighted == (1, 2, 3, 4, 5) == unweighted_stages(tableau.b, tableau.e)
    assert not NYSTROM.shares_stages
    assert NYSTROM.stages == 17


def test_pairs_of_pytrees_in_diffrax():
    """On a Kepler orbit beside `simulate`, within tolerances of both."""

    def field(t, y, args):
        q, v = y
        r = jnp.sqrt(q["x"] ** 2 + q["y"] ** 2)
        return v, jax.tree.map(lambda x: -x / r**3, q)

    start = {"x": jnp.array(0.4), "y": jnp.array(0.0)}, {"x": jnp.array(0.0), "y": jnp.array(2.0)}
    controller = diffrax.PIDController(rtol=1e-10, atol=1e-10)
    solved = diffrax.diffeqsolve(
        diffrax.ODETerm(field), NYSTROM, 0.0, 3.0, None, start, stepsize_controller=controller
    )
    q, v = orbit(0.6, 3.0)
    found = [solved.ys[0]["x"][0], solved.ys[0]["y"][0], solved.ys[1]["x"][0], solved.ys[1]["y"][0]]
    np.testing.assert_allclose(found, [*q, *v], rtol=0, atol=1e-8)


# ---- Motions ---------------------------------------------------------------------------------


def attraction(t, q, v, params):
    return 0.5 * (v @ v) + params["k"] / jnp.sqrt(q @ q)


KEPLER = jl.System(attraction, ("x", "y"))


def orbit(e, t):
    """(q, v) on a Kepler orbit from the pericentre, k = a = 1, by Kepler's equation."""
    E = t
    for _ in range(100):
        E = E - (E - e * np.sin(E) - t) / (1 - e * np.cos(E))
    b, rate = np.sqrt(1 - e * e), 1 / (1 - e * np.cos(E))
    return [np.cos(E) - e, b * np.sin(E)], [-rate * np.sin(E), rate * b * np.cos(E)]


def start(e):
    return [1 - e, 0.0], [0.0, np.sqrt((1 + e) / (1 - e))]


def vibration(t, q, v, params):
    return 0.5 * v[0] ** 2 - 0.5 * q[0] ** 2


def slopes(system, start, end, params, exact, counts):
    """Of log(error) over log(h), between numbers of fixed steps."""
    run = jax.jit(
        lambda dt: jl.simulate(system, *start, [0.0, end], params, method="nystrom12", dt=dt)
    )
    motions = [run(end / n) for n in counts]
    errors = [np.linalg.norm(np.concatenate([m.q[-1], m.v[-1]]) - exact) for m in motions]
    given = pairwise(zip(counts, errors, strict=True))
    return [np.log(a / b) / np.log(n / m) for (m, a), (n, b) in given]


def test_order_of_motions():
    """Errors from 5e-9 to 4e-12, and from 4e-10 to 7e-13.

    The coefficient of h^12 is small: on orbits the slope tends to 12 from below, 11.6, 11.8, 11.85.
    """
    system = jl.System(vibration, ("x",))
    exact = [np.cos(20.0) + 0.3 * np.sin(20.0), 0.3 * np.cos(20.0) - np.sin(20.0)]
    found = slopes(system, ([1.0], [0.3]), 20.0, None, exact, (9, 10, 12, 14, 16))
    assert np.all(np.abs(np.array(found) - 12.0) < 0.1), found
    exact = np.concatenate(orbit(0.1, 6.0))
    found = slopes(KEPLER, start(0.1), 6.0, {"k": 1.0}, exact, (7, 8, 9, 10))
    assert np.all(np.abs(np.array(found) - 12.0) < 0.25), found


@pytest.mark.parametrize("e", [0.0, 0.6, 0.9])
def test_errors_of_orbits_are_of_the_size_of_the_tolerance(e):
    for tolerance in (1e-6, 1e-9, 1e-12):
        motion = jl.simulate(
            KEPLER,
            *start(e),
            [0.0, 2.5, 13.0],
            {"k": 1.0},
            method="nystrom12",
            rtol=tolerance,
            atol=tolerance,
        )
        for row, t in enumerate((0.0, 2.5, 13.0)):
            error = np.max(np.abs(motion.q[row] - np.array(orbit(e, t)[0])))
            assert error < 1e3 * tolerance + 1e-12, (tolerance, t, error)


def test_a_smooth_wall_is_not_missed():
    """A ball falls six times onto an exponential barrier of 1e-4 to 1e-2 m."""

    def barrier(t, q, v, params):
        return 0.5 * v[0] ** 2 - 9.81 * q[0] - jnp.exp(-q[0] / params["w"])

    system = jl.System(barrier, ("x",))
    rng = np.random.default_rng(5)
    h, w = 10 ** rng.uniform(-1, 2, 100), 10 ** rng.uniform(-4, -2, 100)

    def energy(h, w):
        ts = jnp.stack([0.0, 6 * jnp.sqrt(2 * h / 9.81)])
        motion = jl.simulate(
            system, h[None], [0.0], ts, {"w": w}, method="nystrom12", rtol=1e-8, atol=1e-8
        )
        return motion.energy[-1], motion.status

    found, status = jax.jit(jax.vmap(energy))(h, w)
    assert np.all(status == jl.Status.ok)
    assert np.max(np.abs(found / (9.81 * h + np.exp(-h / w)) - 1)) < 1e-5


@pytest.mark.full
def test_derivatives_are_those_of_the_motion():
    """Forward, reverse and second ones beside central differences, in a recorded motion."""

    def end(k):
        ts = [0.0, 1.0, 3.0]
        return jl.simulate(KEPLER, *start(0.6), ts, {"k": k}, method="nystrom12").q[-1, 0]

    reverse, forward = jax.jit(jax.grad(end)), jax.jit(jax.jacfwd(end))
    h = 1e-5
    slope = (end(1.0 + h) - end(1.0 - h)) / (2 * h)
    assert float(reverse(1.0)) == pytest.approx(float(slope), rel=1e-7)
    assert float(reverse(1.0)) == pytest.approx(float(forward(1.0)), rel=1e-12)
    second = jax.jit(jax.jacfwd(jax.grad(end)))(1.0)
    change = (reverse(1.0 + h) - reverse(1.0 - h)) / (2 * h)
    assert float(second) == pytest.approx(float(change), rel=1e-6)


# ---- Which systems ---------------------------------------------------------------------------


def flat(t, q, v, params):
    return 0.5 * (v @ v)


def drag(t, q, v, params):
    return -0.1 * v


def stop(t, q, v, params):
    return -100.0 * jnp.maximum(q, 0.0)


def push(t, q, v, params):
    return 10.0 * q * jnp.exp(-(((t - 7.3) / 0.01) ** 2))


def gauge(t, q, v, params):
    return flat(t, q, v, params) + q[0] * v[0] - 0.5 * (q @ q)


def powers(t, q, v, params):
    return flat(t, q, v, params) + (q @ q) ** -0.5


def pull(t, q, v, params, inputs):
    return inputs["f"] - q


ROD = jl.Holonomic(lambda t, q, params: q @ q - 1.0, "rod")


@pytest.mark.parametrize(
    ("system", "options", "method"),
    [
        (jl.System(flat, ("x", "y"), forces=(jl.GeneralizedForce(drag, "drag"),)), {}, "dopri8"),
        (jl.System(flat, ("x", "y"), forces=(jl.GeneralizedForce(stop, "stop"),)), {}, "dopri8"),
        (jl.System(flat, ("x", "y"), constraints=(ROD,)), {}, "dopri8"),
        (
            jl.System(flat, ("x", "y"), forces=(jl.GeneralizedForce(pull, "pull"),)),
            {"inputs": {"f": jnp.array([0.1, 0.2])}},
            "dopri8",
        ),
        (jl.System(flat, ("x", "y"), forces=(jl.GeneralizedForce(push, "push"),)), {}, "dopri8"),
        (jl.System(flat, ("x", "y")), {}, "nystrom12"),
        (jl.System(gauge, ("x", "y")), {}, "nystrom12"),
        (jl.System(powers, ("x", "y")), {}, "nystrom12"),
        (jl.System(flat, ("x", "y")), {"rtol": 1e-6}, "dopri8"),
        (jl.System(flat, ("x", "y")), {"rtol": 1e-13, "atol": 1e-13}, "nystrom12"),
        (jl.System(flat, ("x", "y")), {"save": ("work",)}, "dopri8"),
    ],
    ids=[
        "drag",
        "kink",
        "constraint",
        "input",
        "time",
        "free",
        "gauge",
        "powers",
        "loose",
        "tight",
        "work",
    ],
)
def test_auto_selects_it_for_smooth_functions_of_q(system, options, method):
    motion = jl.simulate(system, [1.0, 0.0], [0.0, 0.1], [0.0, 0.1], **options)
    assert motion.method == method


def test_its_name_is_accepted_wherever_auto_selects_it():
    """The derivative of a function of (t, q) in L contains v, and drops out of accelerations."""
    system = jl.System(gauge, ("x", "y"))
    motion = jl.simulate(system, [1.0, 0.0], [0.0, 0.5], [0.0, 3.0])
    between = motion.at(1.3)
    np.testing.assert_allclose(between.q[0], [np.cos(1.3), 0.5 * np.sin(1.3)], rtol=0, atol=1e-9)
    again = jl.simulate(system, [1.0, 0.0], [0.0, 0.5], [0.0, 3.0], method=motion.method)
    np.testing.assert_array_equal(again.q, motion.q)


@pytest.mark.parametrize(
    ("system", "text"),
    [
        (
            jl.System(flat, ("x", "y"), forces=(jl.GeneralizedForce(drag, "drag"),)),
            "method Nystrom12 must be used for a system whose forces do not depend on velocities, "
            "but the force 'drag' depends on v. Choose 'dopri8', which takes any Lagrangian.",
        ),
        (
            jl.System(lambda t, q, v, params: 0.5 * (v @ v) * (1.0 + q[0] ** 2), ("x", "y")),
            r"T\(v\) - V\(t, q\) with constant mass matrix, but its mass matrix contains q",
        ),
        (
            jl.System(flat, ("x", "y"), constraints=(ROD,)),
            r"must be used for a system without constraints, but it has constraints \('rod'\)",
        ),
    ],
    ids=["force", "mass", "constraint"],
)
def test_other_systems_are_refused(system, text):
    with pytest.raises(ValueError, match=text):
        jl.simulate(system, [1.0, 0.0], [0.0, 0.1], [0.0, 0.1], method="nystrom12")


def test_work_beside_the_state_is_refused():
    system = jl.System(flat, ("x", "y"), forces=(jl.GeneralizedForce(push, "push"),))
    options = {"method": "nystrom12", "save": ("work",)}
    with pytest.raises(ValueError, match=r"`y` must be \(q, v\) alone, but it contained .*work"):
        jl.simulate(system, [1.0, 0.0], [0.0, 0.1], [0.0, 0.1], **options)
