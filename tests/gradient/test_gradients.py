"""One derivative for every transform: fwd = rev = central differences = variational equations."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _directions import direction, dot
from _families import mostly_full
from _systems.problems import MOTIONS, Motion
from scipy.integrate import solve_ivp

import jaxlag as jl
from jaxlag._gradient import _differentiable_solve, _tangent_map
from jaxlag._simulation import _simulate

NAMES = mostly_full(MOTIONS, "driven_pendulum")


def end(motion: Motion, **options):
    """(q, v) at t1 as a function of every float of the motion: q0, v0, params, inputs, times."""

    def state(x):
        ts = jnp.stack([x["t0"], 0.6 * x["t1"], x["t1"]])
        m = jl.simulate(
            motion.system, x["q0"], x["v0"], ts, x["params"], inputs=x["inputs"], **options
        )
        return jnp.concatenate([m.q[-1], m.v[-1], m.q[1]])

    params = jax.tree.map(jnp.asarray, motion.params)
    x = {"q0": motion.q0, "v0": motion.v0, "params": params, "inputs": motion.inputs}
    return state, x | {"t0": jnp.array(0.0), "t1": jnp.array(motion.t1)}


@pytest.fixture(scope="module")
def derivatives(lowering):
    """Value, one jvp and one vjp of every motion, compiled once."""
    results = {}

    def of(name):
        if name not in results:
            state, x = end(MOTIONS[name])

            @jax.jit
            def both(x, dx):
                weights = jnp.arange(1.0, 1.0 + jax.eval_shape(state, x).shape[0])
                y, dy = jax.jvp(state, (x,), (dx,))
                _, vjp_fn = jax.vjp(state, x)
                return y, dy, weights, vjp_fn(weights)[0]

            results[name] = (state, x, direction(x), both(x, direction(x)))
        return results[name]

    return of


def forward_equals_reverse(derivatives, name):
    """<w, J dx> = <J^T w, dx>, to rounding, because both differentiate one sequence of steps."""
    _, _, dx, (_, dy, weights, gradient) = derivatives(name)
    scale = jnp.sum(jnp.abs(weights * dy)) + dot(
        jax.tree.map(jnp.abs, gradient), jax.tree.map(jnp.abs, dx)
    )
    # Measured 2026-11-21: at most 4e-15 of the scale.
    assert abs(dot(weights, dy) - dot(gradient, dx)) <= 1e-13 * scale


def test_forward_equals_reverse_under_both_lowerings(derivatives):
    """A driven motion, by its start, params, table and times."""
    forward_equals_reverse(derivatives, "driven_pendulum")


@pytest.mark.full
@pytest.mark.parametrize("name", [name for name in MOTIONS if name != "driven_pendulum"])
def test_forward_equals_reverse(derivatives, name):
    forward_equals_reverse(derivatives, name)


def recorded(motion: Motion, x):
    """The saves as a function of x on the grid recorded at x."""
    caught = {}

    def catch(plan, values):
        caught["plan"], caught["values"] = plan, jax.tree.map(jnp.asarray, values)
        raise StopIteration

    catch.programs = lambda: 0
    original = _simulate._simulate
    _simulate._simulate = catch
    try:
        end(motion)[0](x)
    except StopIteration:
        pass
    finally:
        _simulate._simulate = original
    plan, base = caught["plan"], caught["values"]

    def on_grid(outcome, x):
        values = base._replace(
            q0=x["q0"],
            v0=x["v0"],
            ts=jnp.stack([x["t0"], 0.6 * x["t1"], x["t1"]]),
            params=x["params"],
            inputs=base.inputs if x["inputs"] is None else x["inputs"],
        )
        problem = _differentiable_solve.split(_simulate.build_problem(plan, values)[2])
        if outcome is None:
            return _differentiable_solve._recorded(problem)
        replayed = _differentiable_solve._replay(problem, outcome, problem.differentiable)
        n = motion.system.size
        return jnp.concatenate([replayed.saved[-1], replayed.saved[1, :n]])

    outcome = jax.jit(lambda x: on_grid(None, x))(x)
    return jax.jit(lambda x: on_grid(outcome, x))


@pytest.mark.full
@pytest.mark.parametrize("name", NAMES)
def test_derivative_equals_that_of_the_recorded_grid(derivatives, name):
    """Central differences of the steps, repeated on the grid recorded at x."""
    _, x, dx, (y, dy, _, _) = derivatives(name)
    again = recorded(MOTIONS[name], x)
    np.testing.assert_allclose(again(x), y, rtol=0, atol=1e-12)

    def difference(h):
        shifted = [jax.tree.map(lambda a, b, s=s: a + s * h * b, x, dx) for s in (1, -1)]
        return (again(shifted[0]) - again(shifted[1])) / (2 * h)

    # Richardson: h^4 error, h = 2e-4, so eps/h = 1e-12; measured worst 2026-11-21: 3e-9 relative.
    h = 2e-4
    extrapolated = (4 * difference(h / 2) - difference(h)) / 3
    np.testing.assert_allclose(dy, extrapolated, rtol=3e-8, atol=3e-8 * np.abs(dy).max())


def variational(motion: Motion, dx):
    """dx(t1) by the variational equations with scipy, for changes of q0, v0 and params."""
    n = motion.system.size

    @jax.jit
    def rate(t, y, dy):
        def field(y, params):
            a = motion.system.acceleration(y[:n], y[n:], params, t=t, inputs=motion.inputs)
            return jnp.concatenate([y[n:], a])

        params = jax.tree.map(jnp.asarray, motion.params)
        return jnp.concatenate(jax.jvp(field, (y, params), (dy, dx["params"])))

    y = np.concatenate([motion.q0, motion.v0, dx["q0"], dx["v0"]])
    knots = [] if motion.inputs is None else np.asarray(motion.inputs["tau"].times[1:-1])
    marks = [0.0, *[k for k in knots if k < motion.t1], motion.t1]
    for a, b in itertools.pairwise(marks):
        # Do not read beyond a jump: the input is right-continuous.
        late = np.nextafter(b, a) if b in knots else b
        fun = lambda t, y: rate(min(t, late), y[: 2 * n], y[2 * n :])  # noqa: E731, B023
        y = solve_ivp(fun, (a, b), y, method="DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    return y[2 * n :]


@pytest.mark.full
@pytest.mark.parametrize("name", MOTIONS)
def test_derivative_matches_variational_equations(name):
    """At a tight tolerance the derivative of the fixed grid is that of the motion."""
    motion = MOTIONS[name]
    state, x = end(motion, rtol=1e-12, atol=1e-12)
    dx = direction(x, 1)
    dx = {
        k: v if k in ("q0", "v0", "params") else jax.tree.map(jnp.zeros_like, v)
        for k, v in dx.items()
    }
    _, dy = jax.jit(lambda x, dx: jax.jvp(state, (x,), (dx,)))(x, dx)
    expected = variational(motion, dx)
    n = motion.system.size
    # Both integrated to 1e-12; measured worst 2026-11-21: 2e-10 of the largest.
    np.testing.assert_allclose(dy[: 2 * n], expected, rtol=0, atol=2e-9 * np.abs(expected).max())


@pytest.mark.full
def test_derivatives_by_times_are_velocities(derivatives):
    """dq/dt1 = v(t1); a shift of all times of an autonomous motion changes nothing."""
    state, x, _, (y, *_) = derivatives("double_pendulum")
    zero = jax.tree.map(jnp.zeros_like, x)
    one = jnp.array(1.0)
    jvp = jax.jit(lambda dx: jax.jvp(state, (x,), (dx,))[1])
    by_end = jvp(zero | {"t1": one})
    np.testing.assert_allclose(by_end[:2], y[2:4], rtol=1e-7, atol=0)  # v is right to 1e-9
    # t1 -> t1 + s, t0 -> t0 + s, and the middle save 0.6 t1 moves by 0.6 s only.
    by_clock = jvp(zero | {"t0": one, "t1": one})
    assert np.abs(by_clock[:4]).max() < 1e-9 * np.abs(y).max()


@pytest.mark.full
def test_saves_have_derivatives_by_their_own_time():
    """d x(ts[i]) / d ts[i] = v, also on a step of a fixed grid and on a knot."""
    free = jl.System(lambda t, q, v, p: 0.5 * v[0] ** 2, ("x",))
    save = jax.grad(lambda ts: jl.simulate(free, [0.0], [2.0], ts, dt=0.25).q[1, 0])
    for middle in (0.5, 0.51):
        slope = save(jnp.array([0.0, middle, 1.0]))
        np.testing.assert_allclose(slope, [-2.0, 2.0, 0.0], rtol=0, atol=1e-13)

    def pushed(at, knot):
        """The save at `at` under a force 5 t / knot, up to the knot."""
        force = jl.GeneralizedForce(lambda t, q, v, p, inputs: inputs["u"][None], "push")
        system = jl.System(lambda t, q, v, p: 0.5 * v[0] ** 2, ("x",), forces=(force,))
        table = jl.LinearInterpolation(jnp.stack([0.0, knot, 1.0]), jnp.array([0.0, 5.0, 1.0]))
        ts = jnp.stack([0.0, at, 1.0])
        return jl.simulate(system, [0.0], [0.0], ts, inputs={"u": table}).q[1, 0]

    by_time, by_knot = jax.grad(pushed, argnums=(0, 1))(0.5, 0.5)
    np.testing.assert_allclose(by_time, 5 * 0.5 / 2, rtol=1e-12)  # v = 5 t^2 / (2 knot)
    np.testing.assert_allclose(by_knot, -5 * 0.5 / 6, rtol=1e-12)  # x = 5 t^3 / (6 knot)


@pytest.mark.full
@pytest.mark.parametrize("mode", mostly_full(("recorded", "checkpoints", "forward"), "recorded"))
def test_derivative_by_the_start_time_under_a_table_is_exact(mode):
    """x'' = 1 + 2 t from rest at t0: dx(t1)/dt0 = -(1 + 2 t0) (t1 - t0).

    The reference of times in between has no effect.
    """
    force = jl.GeneralizedForce(lambda t, q, v, p, inputs: inputs["u"][None], "push")
    system = jl.System(lambda t, q, v, p: 0.5 * v[0] ** 2, ("x",), forces=(force,))
    table = jl.LinearInterpolation([0.0, 1.0, 2.0, 3.0], [1.0, 3.0, 5.0, 7.0])

    def end(t0):
        ts = jnp.stack([t0, 2.5])
        return jl.simulate(system, [0.0], [0.0], ts, inputs={"u": table}, gradient=mode).q[-1, 0]

    for slope in (jax.grad, jax.jacfwd):
        np.testing.assert_allclose(slope(end)(0.3), -1.6 * 2.2, rtol=1e-12)
    np.testing.assert_allclose(jax.jacrev(jax.grad(end))(0.3), 1.6 - 2 * 2.2, rtol=1e-11)


def test_derivative_by_end_given_in_a_list():
    free = jl.System(lambda t, q, v, p: 0.5 * v[0] ** 2, ("x",))
    slope = jax.grad(lambda end: jl.simulate(free, [0.0], [2.0], [0.0, end]).q[-1, 0])(1.0)
    np.testing.assert_allclose(slope, 2.0, rtol=1e-14)


@pytest.mark.full
def test_derivative_by_switching_time():
    """d theta(t1) / d t_switch = (Q_before - Q_after) / J (t1 - t_switch) for a free rotor."""
    rotor = jl.System(
        lambda t, q, v, p: 0.5 * p * v[0] ** 2,
        ("theta",),
        forces=(jl.GeneralizedForce(lambda t, q, v, p, inputs: inputs["tau"][None], "motor"),),
    )

    def angle(switch):
        tau = jl.ZeroOrderHold(jnp.stack([0.0, switch, 2.0]), jnp.array([3.0, -1.0, 0.0]))
        motion = jl.simulate(rotor, [0.0], [0.0], [0.0, 1.0, 1.5], 2.0, inputs={"tau": tau})
        return motion.q[-1, 0]

    switch = jnp.array(0.7)
    value, slope = jax.value_and_grad(angle)(switch)
    np.testing.assert_allclose(value, 0.5 * 1.5 * 1.5**2 - 0.5 * 2.0 * 0.8**2, rtol=1e-12)
    np.testing.assert_allclose(slope, 2.0 * 0.8, rtol=1e-12)


@pytest.mark.full
@pytest.mark.parametrize("method", ["kvaerno3", "tsit5"])
@pytest.mark.parametrize("dt", [None, 0.02])
def test_forward_equals_reverse_for_every_kind_of_solver(method, dt):
    """fwd = rev for implicit and explicit, adaptive and fixed steps."""
    tolerance = {} if dt else {"rtol": 1e-6, "atol": 1e-6}
    state, x = end(MOTIONS["central_motion"], method=method, dt=dt, **tolerance)
    weights = jnp.arange(1.0, 7.0)
    forward = jax.jit(jax.jacfwd(lambda x: weights @ state(x)))(x)
    reverse = jax.jit(jax.grad(lambda x: weights @ state(x)))(x)
    for a, b in zip(jax.tree.leaves(forward), jax.tree.leaves(reverse), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-10)


@pytest.mark.full
def test_hessian_of_a_short_program_is_right():
    """All orders of the two modes, against differences of the gradient; sines are polynomials."""
    pendulum = jl.System(lambda t, q, v, p: 0.5 * v[0] ** 2 + p * jnp.cos(q[0]), ("x",))
    q0, p, h = jnp.array([0.1]), jnp.array(9.81), 1e-4

    def loss(p):
        motion = jl.simulate(pendulum, q0, [0.3], [0.0, 0.5, 1.0], p, method="tsit5", dt=0.02)
        return jnp.sum(motion.q[1:] ** 2)

    slope = jax.jit(jax.grad(loss))
    by_differences = (slope(p + h) - slope(p - h)) / (2 * h)  # errors: h^2 and rounding over h
    forward, reverse = jax.jacfwd, jax.grad
    for outer, inner in itertools.product((forward, reverse), repeat=2):
        found = jax.jit(outer(inner(loss)))(p)
        np.testing.assert_allclose(found, by_differences, rtol=1e-6)


@pytest.mark.full
def test_hessian_is_symmetric_and_right():
    """jacfwd of grad: symmetric to rounding, equal to differences of the gradient (fixed grid)."""
    motion = MOTIONS["central_motion"]

    def angle(z):
        m = jl.simulate(motion.system, z[:2], z[2:], [0.0, 1.0], motion.params, dt=0.05)
        return m.q[-1] @ jnp.array([1.0, 2.0])

    z = jnp.concatenate([motion.q0, motion.v0])
    gradient = jax.jit(jax.grad(angle))
    H = jax.jit(jax.hessian(angle))(z)
    np.testing.assert_allclose(H, H.T, rtol=0, atol=1e-12 * np.abs(H).max())
    h = 1e-4
    columns = [(gradient(z + h * e) - gradient(z - h * e)) / (2 * h) for e in np.eye(4)]
    # Truncation h^2 times the third derivative; measured worst 2026-11-21: 2e-7 of the largest.
    np.testing.assert_allclose(H, np.array(columns), rtol=0, atol=2e-6 * np.abs(H).max())
    mixed = jax.jit(jax.jacrev(jax.jacfwd(angle)))(z)
    np.testing.assert_allclose(mixed, H, rtol=0, atol=1e-11 * np.abs(H).max())


@pytest.mark.full
@pytest.mark.parametrize(
    ("name", "dt", "rtol"),
    [
        ("driven_pendulum", 0.02, 1e-12),
        ("central_motion", None, 1e-8),
    ],
)
def test_vmap_of_grad_equals_loop_of_grad(name, dt, rtol):
    """To rounding on a fixed grid; an adaptive one depends on errors that round differently."""
    motion = MOTIONS[name]

    def angle(q0, params):
        ts = [0.0, 0.5, 1.0]
        m = jl.simulate(motion.system, q0, motion.v0, ts, params, inputs=motion.inputs, dt=dt)
        return m.q[-1, 0] + m.q[1, 0] ** 2

    gradient = jax.grad(angle, argnums=(0, 1))
    params = jax.tree.map(jnp.asarray, motion.params)
    starts = motion.q0 + jnp.linspace(-0.1, 0.1, 3)[:, None]
    batch = jax.jit(jax.vmap(gradient, in_axes=(0, None)))(starts, params)
    single = jax.jit(gradient)
    for i, q0 in enumerate(starts):
        for a, b in zip(jax.tree.leaves(batch), jax.tree.leaves(single(q0, params)), strict=True):
            np.testing.assert_allclose(a[i], b, rtol=rtol, atol=rtol)


@pytest.mark.full
def test_saves_that_are_not_reached_keep_the_gradient_finite():
    """A motion that fails has NaN saves, and a finite gradient of the saves that it reached."""
    system = jl.System(
        lambda t, q, v, p: 0.5 * v[0] ** 2 + p * jnp.sqrt(1.0 - q[0]), ("x",)
    )  # undefined beyond x = 1

    def reached(v0):
        m = jl.simulate(system, [0.0], v0, jnp.linspace(0.0, 2.0, 9), 0.1, throw=False)
        return jnp.sum(jnp.where(jnp.isnan(m.q), 0.0, m.q)), m.status

    (_, status), slope = jax.value_and_grad(reached, has_aux=True)(jnp.array([1.0]))
    assert status == jl.Status.nonfinite
    assert np.isfinite(slope).all()
    assert slope[0] > 0.5  # saves at 0.25, 0.5, 0.75 depend on v0

    def failed(q0):
        m = jl.simulate(system, q0, [0.0], [0.0, 1.0, 2.0], 0.1, throw=False)
        return jnp.sum(jnp.where(jnp.isnan(m.q[1:]), 0.0, m.q[1:]))

    np.testing.assert_array_equal(jax.grad(failed)(jnp.array([2.0])), [0.0])


@pytest.mark.full
def test_wrong_sign_of_the_tangent_rule_is_detected(derivatives, monkeypatch):
    """The comparisons above fail for a wrong sign of the tangent rule."""
    _, x, dx, (_, dy, _, _) = derivatives("central_motion")
    right = _differentiable_solve.changes
    monkeypatch.setattr(
        _differentiable_solve, "changes", lambda *args: jax.tree.map(jnp.negative, right(*args))
    )
    state, _ = end(MOTIONS["central_motion"], max_steps=4097)  # another program: no cache is used
    _, wrong = jax.jit(lambda x, dx: jax.jvp(state, (x,), (dx,)))(x, dx)
    np.testing.assert_allclose(wrong, -dy, rtol=1e-9)
    again = recorded(MOTIONS["central_motion"], x)
    h = 1e-5
    shifted = [jax.tree.map(lambda a, b, s=s: a + s * h * b, x, dx) for s in (1, -1)]
    with pytest.raises(AssertionError):
        np.testing.assert_allclose(
            wrong, (again(shifted[0]) - again(shifted[1])) / (2 * h), rtol=1e-2
        )


@pytest.mark.full
def test_wrong_sign_of_the_adjoint_is_detected(derivatives, monkeypatch):
    """The comparison of forward with reverse fails for a wrong sign of the transposed map."""
    _, x, dx, (_, dy, weights, _) = derivatives("central_motion")
    right = _tangent_map.adjoint_sweep
    monkeypatch.setattr(
        _tangent_map, "adjoint_sweep", lambda *args: jax.tree.map(jnp.negative, right(*args))
    )
    state, _ = end(MOTIONS["central_motion"], max_steps=4098)  # another program: no cache is used
    gradient = jax.jit(lambda x: jax.vjp(state, x)[1](weights)[0])(x)
    scale = jnp.sum(jnp.abs(weights * dy))
    assert abs(dot(weights, dy) - dot(gradient, dx)) > 1e-3 * scale
