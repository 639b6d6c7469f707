"""Solvers of jaxlag against the same methods of diffrax: order, error estimate, interpolation."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl

EPS = np.finfo(float).eps


def swing(t, y, args):
    """A pendulum with the forcing args cos t; y is a vector."""
    return jnp.stack([y[1], -jnp.sin(y[0]) + args * jnp.cos(t)])


def swing_by_parts(t, y, args):
    """The same with y a dict."""
    return {"angle": y["rate"], "rate": -jnp.sin(y["angle"]) + args * jnp.cos(t)}


Y0, PUSH = jnp.array([1.0, 0.2]), jnp.array(0.3)


def one_step(solver, h, y0=Y0, field=swing):
    term = diffrax.ODETerm(field)
    t0, t1 = jnp.array(0.3), jnp.array(0.3) + h
    memory = solver.init(term, t0, t1, y0, PUSH)
    return solver.step(term, t0, t1, y0, PUSH, memory, made_jump=False)


PAIRS = [jl.solvers.Tsit5(), jl.solvers.Dopri5(), jl.solvers.Dopri8(), jl.solvers.Prince9()]
NAMED = pytest.mark.parametrize("solver", PAIRS, ids=lambda solver: type(solver).__name__)
LOOPED = pytest.mark.parametrize("looped", [False, True], ids=["written_out", "in_a_loop"])


@LOOPED
@NAMED
def test_a_step_is_that_of_the_same_method_of_diffrax(solver, looped):
    """To rounding of the largest sum: y1, the error estimate, stages and the next first stage."""
    solver = type(solver)(looped=looped)
    y1, error, dense, last, _ = one_step(solver, 0.2)
    y1_, error_, dense_, (_, last_), _ = one_step(solver.stock, 0.2)
    most = max(np.abs(stage).sum() for stage in solver.stock.tableau.a_lower)
    for a, b in ((y1, y1_), (error, error_), (dense["k"], dense_["k"]), (last, last_)):
        np.testing.assert_allclose(a, b, rtol=0, atol=32 * EPS * max(most, 2))


class Halves(diffrax.ODETerm):
    """Two coupled pendulums with drag, y = (q, v) a vector; also backward in time."""

    in_lanes: bool
    second_order: bool
    time_direction: float

    def __init__(self, lanes, second_order, time_direction):
        def field(t, y, args):
            q, v = y[:2], y[2:]
            acceleration = args * jnp.cos(t) - jnp.sin(q) + 0.4 * q[::-1] - 0.3 * v * jnp.abs(v)
            return time_direction * jnp.concatenate([v, acceleration])

        super().__init__(field)
        self.in_lanes, self.second_order, self.time_direction = lanes, second_order, time_direction

    def sections(self, y):
        return y[:2], y[2:], y[4:]

    def signed(self, x, args):
        return jax.tree.map(lambda x: self.time_direction * x, x)


class Heun(jl.solvers.AbstractRungeKutta):
    """A method whose steps do not share a stage."""

    interpolation_cls = diffrax.Heun.interpolation_cls

    @property
    def stock(self):
        return diffrax.Heun()


@pytest.mark.full
@pytest.mark.parametrize("time_direction", [1.0, -1.0], ids=["onwards", "backwards"])
@pytest.mark.parametrize("second_order", [True, False], ids=["nystrom", "first_order"])
@pytest.mark.parametrize("lanes", [True, False], ids=["lanes", "alone"])
@pytest.mark.parametrize("solver", [*PAIRS, Heun()], ids=lambda solver: type(solver).__name__)
def test_a_step_has_the_same_values_in_every_form(solver, lanes, second_order, time_direction):
    """To rounding of the largest sum: sums of accelerations only, or sums over lanes."""
    y0 = jnp.asarray(np.random.default_rng(2).uniform(-1.5, 1.5, (3, 4)))
    t0, t1 = jnp.array(0.3), jnp.array(0.55)
    forms = Halves(lanes, second_order, time_direction), Halves(False, False, time_direction)

    def step(method, terms, y0):
        memory = method.init(terms, t0, t1, y0, PUSH)
        y1, error, dense, last, _ = method.step(terms, t0, t1, y0, PUSH, memory, made_jump=False)
        return y1, error, dense["k"], last

    found = jax.vmap(lambda y0: step(solver, forms[0], y0))(y0)
    expected = jax.vmap(lambda y0: step(solver.stock, forms[1], y0))(y0)
    most = max(np.abs(stage).sum() for stage in solver.stock.tableau.a_lower)
    rounding = 32 * EPS * max(most, 2)
    for a, b in zip(found[:3], expected[:3], strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=rounding)
    assert solver.shares_stages == (found[3] is not None)
    if solver.shares_stages:
        np.testing.assert_allclose(found[3], expected[3][1], rtol=0, atol=rounding)

    # The first stage is computed again if the field jumps, also if that is known only at run time.
    def jumping(jumped, y0):
        return solver.step(forms[0], t0, t1, y0, PUSH, jnp.full(4, jnp.nan), made_jump=jumped)[0]

    for jumped in (True, jnp.array(True)):
        anew = jax.vmap(jumping, (None, 0))(jumped, y0)
        np.testing.assert_allclose(anew, found[0], rtol=0, atol=4 * EPS)


def trees(order):
    """Rooted trees with that many nodes, each the sorted tuple of its branches."""

    def forests(nodes, largest):
        if nodes == 0:
            yield ()
            return
        for size in range(min(nodes, largest[0]), 0, -1):
            for index, tree in enumerate(trees(size)):
                if (size, index) <= largest:
                    for rest in forests(nodes - size, (size, index)):
                        yield (tree, *rest)

    if order not in _TREES:
        _TREES[order] = list(forests(order - 1, (order - 1, len(trees(order - 1)))))
    return _TREES[order]


_TREES = {1: [()]}


def weight(tree, A):
    """(stage values of the elementary differential, gamma of the tree, its order)."""
    parts = [weight(branch, A) for branch in tree]
    order = 1 + sum(part[2] for part in parts)
    values = np.prod([A @ part[0] for part in parts] or [np.ones(len(A))], axis=0)
    return values, order * np.prod([part[1] for part in parts] or [1.0]), order


def defect(b, A, order, s=1.0):
    """Largest violation of the conditions of that order at the part s of the step."""
    found = [weight(tree, A) for tree in trees(order)]
    return max(abs(b @ values - s**n / gamma) for values, gamma, n in found)


def coefficients(method):
    tableau = method.tableau
    A = np.zeros((len(tableau.c) + 1,) * 2)
    for i, stage in enumerate(tableau.a_lower, 1):
        A[i, : len(stage)] = stage
    return A, np.asarray(tableau.b_sol), np.asarray(tableau.b_sol) - np.asarray(tableau.b_error)


@NAMED
def test_tableaus_satisfy_the_conditions_of_their_order_and_no_more(solver):
    """All trees: 1, 1, 2, 4, 9, 20, 48, 115, 286, 719. Stages times weights round by 1e-14."""
    A, b, lower = coefficients(solver.stock)
    order, embedded = solver.order(None), solver.error_order(None) - 1
    assert len(trees(order)) == [1, 1, 2, 4, 9, 20, 48, 115, 286, 719][order - 1]
    rounding = 1e2 * EPS * max(1.0, np.abs(A).max())
    assert max(defect(b, A, p) for p in range(1, order + 1)) < rounding
    assert max(defect(lower, A, p) for p in range(1, embedded + 1)) < rounding
    # The methods of order 8 and 9 leave little by design: Prince9 1.9e-9, 1900 roundings.
    assert defect(b, A, order + 1) > 1e3 * rounding
    assert defect(lower, A, embedded + 1) > 1e3 * rounding
    wrong = A.copy()
    wrong[-2, 0] *= 1 + 1e-9
    assert max(defect(b, wrong, p) for p in range(1, order + 1)) > rounding


def test_output_between_steps_of_order_9_is_of_order_8():
    from jaxlag.solvers._prince9 import _OUTPUT

    A, b, _ = coefficients(jl.solvers.Prince9().stock)
    rounding = 1e2 * EPS * np.abs(_OUTPUT).max()
    for s in (0.2, 0.5, 0.9):
        between = np.asarray(_OUTPUT) @ s ** np.arange(1, 9)
        assert max(defect(between, A, p, s) for p in range(1, 9)) < rounding
        assert defect(between, A, 9, s) > 1e-9
    np.testing.assert_allclose(np.sum(_OUTPUT, axis=1), b, atol=rounding)
    solver, h = jl.solvers.Prince9(), jnp.array(0.8)
    y1, _, dense, _, _ = one_step(solver, h)
    output = solver.interpolation_cls(t0=jnp.array(0.3), t1=0.3 + h, **dense)
    np.testing.assert_allclose(output.evaluate(0.3 + h), y1, atol=rounding)
    half = one_step(solver, h / 2)[0]
    # Bound: its error at the middle falls as h^9, 8.7e-9 at h = 0.9.
    np.testing.assert_allclose(output.evaluate(0.3 + h / 2), half, atol=8.7e-9)


@LOOPED
def test_states_may_be_pytrees(looped):
    y0 = {"angle": jnp.array(1.0), "rate": jnp.array(0.2)}
    y1 = one_step(jl.solvers.Dopri8(looped), 0.2, y0, swing_by_parts)[0]
    flat = one_step(jl.solvers.Dopri8(), 0.2)[0]
    np.testing.assert_allclose([y1["angle"], y1["rate"]], flat, rtol=4 * EPS)


def test_order_of_the_step_and_of_its_error_estimate():
    """Local errors fall as h^9 and h^8, within 0.1 in the exponent."""
    fine = jax.jit(
        lambda h: diffrax.diffeqsolve(
            diffrax.ODETerm(swing),
            diffrax.Dopri8(),
            0.3,
            0.3 + h,
            h / 16,
            Y0,
            PUSH,
            stepsize_controller=diffrax.ConstantStepSize(),
        ).ys[0]
    )
    h = 0.8 * 2.0 ** -(np.arange(3) ** 0.5)
    steps = [one_step(jl.solvers.Dopri8(), x) for x in h]
    errors = [np.linalg.norm(step[0] - fine(x)) for step, x in zip(steps, h, strict=True)]
    slope = np.polyfit(np.log(h), np.log(errors), 1)[0]
    assert abs(slope - 9) < 0.35, slope
    estimates = [np.linalg.norm(step[1]) for step in steps]
    assert abs(np.polyfit(np.log(h), np.log(estimates), 1)[0] - 8) < 0.35


@pytest.mark.full
def test_solver_works_in_diffrax():
    """Dense output and derivatives in any mode agree with the method of diffrax."""

    def solve(solver, push):
        return diffrax.diffeqsolve(
            diffrax.ODETerm(swing),
            solver,
            0.0,
            5.0,
            None,
            Y0,
            push,
            saveat=diffrax.SaveAt(ts=jnp.linspace(0.0, 5.0, 11)),
            stepsize_controller=diffrax.PIDController(rtol=1e-9, atol=1e-9),
        ).ys

    found, expected = (
        jax.jit(lambda push, s=s: (solve(s, push), jax.jacrev(lambda p: solve(s, p))(push)))(PUSH)
        for s in (jl.solvers.Dopri8(), diffrax.Dopri8())
    )
    # Rounding changes the steps slightly: both are within the tolerance of the truth.
    np.testing.assert_allclose(found[0], expected[0], rtol=1e-9)
    np.testing.assert_allclose(found[1], expected[1], rtol=1e-8)


@LOOPED
@pytest.mark.parametrize("made_jump", [False, True])
def test_steps_share_a_stage_unless_the_field_jumped(made_jump, looped):
    """Known while tracing or not, and for each of several lanes."""
    solver, term = jl.solvers.Dopri8(looped), diffrax.ODETerm(swing)
    _, _, _, last, _ = one_step(solver, 0.2)
    wrong = last + 1.0

    def step(jump):
        ends = jnp.array(0.3), jnp.array(0.5)
        return solver.step(term, *ends, Y0, PUSH, wrong, made_jump=jump)[0]

    right = one_step(solver, 0.2)[0]
    for found in (step(made_jump), jax.jit(step)(jnp.array(made_jump))):
        assert (np.abs(found - right).max() < 32 * EPS) == made_jump
    lanes = jax.jit(jax.vmap(step))(jnp.array([made_jump, not made_jump]))
    moved = np.abs(lanes - right).max(axis=1)
    np.testing.assert_array_equal(moved < 32 * EPS, [made_jump, not made_jump])


def test_loop_over_stages_contains_the_field_once():
    """Unrolled, a step of order 8 contains it 13 times, plus the first stage of the first step."""
    term = diffrax.ODETerm(swing)

    def copies(looped, made_jump):
        solver = jl.solvers.Dopri8(looped)
        ends = jnp.array(0.3), jnp.array(0.5)

        def step(y0, first):
            return solver.step(term, *ends, y0, PUSH, first, made_jump=made_jump)[0]

        return str(jax.make_jaxpr(step)(Y0, Y0)).count("= sin ")

    assert [copies(False, False), copies(False, True)] == [13, 14]
    assert [copies(True, False), copies(True, True)] == [1, 1]
