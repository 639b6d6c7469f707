"""All gradient modes give the same derivative, for every kind of equations."""

from functools import cache, partial

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _directions import direction, dot
from _jaxprs import largest, operations

import jaxlag as jl
from jaxlag._gradient._modes import capacity_for, most_steps, needed
from systems.catalogue import find

# Duration of each motion, s. Starts are assembled if constraints apply.
SPANS = {
    "double_pendulum": 2.0,
    "sleeve_pendulum": 2.0,
    "cart_pendulum": 2.0,
    "double_pendulum_cartesian": 1.5,
    "falling_stick_friction": 0.25,
    "rigid_aircraft": 1.0,
    "tricycle": 2.0,
}
LONG = ("double_pendulum_cartesian", "falling_stick_friction", "rigid_aircraft", "tricycle")
"""Those with a long right-hand side: by tsit5, which compiles half as much."""
MODES = ("recorded", "checkpoints", "forward")
ALL_MODES = ("double_pendulum", "tricycle")
"""The others have one reverse mode tested."""
TIGHT = 1e-13


class Case:
    """The end of an example as a function of its start, its params and its times."""

    def __init__(self, name):
        entry = find(name)
        self.system, span = entry.system, SPANS[name]
        self.method = "tsit5" if name in LONG else "auto"
        q0, v0 = (jnp.asarray(x, float) for x in entry.start())
        params = {k: jnp.asarray(x, float) for k, x in entry.example.params.items()}
        self.x = {"q0": q0, "params": params, "t0": jnp.array(0.1), "t1": jnp.array(span)}
        quasi = self.system.quasi
        if quasi is None:
            self.x["v0"] = v0
        else:
            self.x["u0"] = self.system.quasi_velocities(q0, v0, params, t=0.1)
        self.dx = direction(self.x)
        if quasi is not None:
            free = np.zeros(len(quasi.names))
            free[list(quasi.free)] = 1.0
            self.dx["u0"] = self.dx["u0"] * free

    def end(self, x, tolerance, mode="auto"):
        x = dict(x)
        t0, t1 = x.pop("t0"), x.pop("t1")
        motion = jl.simulate(
            self.system,
            ts=jnp.stack([t0, 0.6 * t1, t1]),
            rtol=tolerance,
            atol=tolerance,
            gradient=mode,
            assemble=bool(self.system.constraints),
            throw=False,
            max_steps=2048,
            method=self.method,
            **({"v0": None} | x),
        )
        found = jnp.concatenate([motion.q[-1], motion.v[-1], motion.q[1]])
        return jnp.where(motion.status == 0, found, jnp.nan), motion.gradient_mode

    @property
    def weights(self):
        return jnp.arange(1.0, 1.0 + 3 * self.system.size)


@cache
def case(name):
    return Case(name)


@pytest.fixture(scope="module")
def forward(lowering):
    """(value, derivative in the direction dx) by forward mode, at any tolerance."""
    programs = {}

    def of(name, tolerance):
        this = case(name)
        if name not in programs:
            programs[name] = jax.jit(
                lambda x, tolerance: jax.jvp(lambda x: this.end(x, tolerance)[0], (x,), (this.dx,))
            )
        return programs[name](this.x, tolerance)

    return of


@pytest.mark.full
@pytest.mark.parametrize("name", SPANS)
def test_all_modes_agree(forward, name):
    """Reverse in each mode against forward: <w, J dx> = <J^T w, dx>; also at a tight tolerance.

    If the step-size control were evaluated again, steps would differ there: error estimates are
    differences that round differently in every program.
    """
    this = case(name)
    for mode in MODES if name in ALL_MODES else MODES[:1]:

        def reverse(x, tolerance, mode=mode):
            _, vjp_fn, kind = jax.vjp(lambda x: this.end(x, tolerance, mode), x, has_aux=True)
            return vjp_fn(this.weights)[0], kind

        program = jax.jit(reverse)
        for tolerance in (1e-9, 1e-11):
            _, dy = forward(name, tolerance)
            bar, kind = program(this.x, tolerance)
            scale = jnp.sum(jnp.abs(this.weights * dy)) + dot(
                jax.tree.map(jnp.abs, bar), jax.tree.map(jnp.abs, this.dx)
            )
            # Derivatives of the same steps: rounding, and that of projections solved to 1e-15.
            assert abs(dot(this.weights, dy) - dot(bar, this.dx)) <= 1e-12 * scale
            wanted = {jl.GradientMode[mode]}
            if mode == "checkpoints":
                wanted.add(jl.GradientMode.recorded)  # if all steps fit
            assert jl.GradientMode(int(kind)) in wanted


@pytest.mark.full
@pytest.mark.parametrize("name", SPANS)
def test_derivative_equals_that_of_the_motion(forward, name):
    """Against differences of solves at a tight tolerance; as accurate as the solution."""
    this = case(name)
    solve = jax.jit(lambda x: this.end(x, TIGHT)[0])

    def difference(h):
        shifted = [jax.tree.map(lambda a, b, s=s: a + s * h * b, this.x, this.dx) for s in (1, -1)]
        return (solve(shifted[0]) - solve(shifted[1])) / (2 * h)

    h = 1e-3
    once, twice = difference(h), difference(h / 2)
    extrapolated = (4 * twice - once) / 3
    y, dy = forward(name, TIGHT)
    # The error of the extrapolation is less than its last correction; rounding is 1e-13 / h.
    allowed = np.abs(twice - once).max() + 1e-9 * np.abs(dy).max()
    np.testing.assert_allclose(dy, extrapolated, rtol=0, atol=allowed)
    loose, loose_dot = forward(name, 1e-9)
    off = np.abs(loose - y).max() / np.abs(y).max()
    # Local errors are 1e-9 of the state. Their effect on the derivative is at most ten times their
    # effect on the solution, down to the tolerance itself.
    assert np.abs(loose_dot - dy).max() <= 10 * max(off, 1e-9) * np.abs(dy).max()


@pytest.mark.full
def test_checkpoints_are_thinned_out_on_long_motions():
    """3 checkpoints for 300 steps: the same gradient as from all states."""
    pendulum = jl.System(lambda t, q, v, p: 0.5 * v[0] ** 2 + p * jnp.cos(q[0]), ("x",))

    def angle(q0, mode, max_steps):
        motion = jl.simulate(
            pendulum,
            q0,
            [0.3],
            [0.0, 1.1, 3.0],
            9.81,
            dt=0.01,
            gradient=mode,
            max_steps=max_steps,
        )
        return motion.q[-1, 0] + motion.q[1, 0], motion.gradient_mode

    found = {}
    for mode, max_steps in (("recorded", 320), ("checkpoints", 320), ("auto", 32768)):
        gradient = jax.jit(jax.grad(angle, has_aux=True), static_argnums=(1, 2))
        found[mode], kind = gradient(jnp.array([1.0]), mode, max_steps)
        assert kind == {"checkpoints": 3}.get(mode, 2)
    np.testing.assert_allclose(found["checkpoints"], found["recorded"], rtol=1e-13)
    np.testing.assert_allclose(found["auto"], found["recorded"], rtol=1e-13)


@pytest.mark.full
@pytest.mark.parametrize("mode", ["recorded", "checkpoints", "forward"])
def test_lanes_that_reach_saves_in_different_iterations_have_gradients(mode):
    """Some have several saves in a step, some one in several; each has its own gradient."""
    pendulum = jl.System(lambda t, q, v, p: 0.5 * v[0] ** 2 + p * jnp.cos(q[0]), ("x",))
    rng = np.random.default_rng(0)
    parts, weights = np.sort(rng.uniform(0.0, 1.0, 30)), rng.uniform(-1.0, 1.0, 31)
    parts[0], parts[17] = 0.0, parts[16] + 1e-9

    def loss(q0, end):
        motion = jl.simulate(
            pendulum, q0, [0.3], end * jnp.append(parts, 1.0), 9.81, dt=0.02,
            gradient=mode, max_steps=256,
        )  # fmt: skip
        return motion.q[:, 0] @ weights

    gradient = jax.jit(jax.value_and_grad(loss, argnums=(0, 1)))
    starts, ends = jnp.linspace(0.5, 1.5, 5)[:, None], jnp.array([0.5, 1.0, 4.0, 2.0, 0.03])
    batch = jax.jit(jax.vmap(jax.value_and_grad(loss, argnums=(0, 1))))(starts, ends)
    for i in range(5):
        alone = jax.tree.leaves(gradient(starts[i], ends[i]))
        for a, b in zip(jax.tree.leaves(batch), alone, strict=True):
            np.testing.assert_allclose(a[i], b, rtol=1e-12, atol=1e-12)
    # Against differences, which round by 1e-16 / 1e-5.
    for j, h in enumerate((1e-5, 1e-5)):
        shift = [0.0, 0.0]
        shift[j] = h
        up, down = (gradient(starts[3] + s * shift[0], ends[3] + s * shift[1])[0] for s in (1, -1))
        np.testing.assert_allclose(batch[1][j][3].sum(), (up - down) / (2 * h), rtol=1e-6)


@pytest.mark.full
def test_gradients_are_traced_once():
    """New values of start, params and tolerance trace nothing again."""
    count = []

    def lagrangian(t, q, v, p):
        count.append(1)
        return 0.5 * v[0] ** 2 + p * jnp.cos(q[0])

    pendulum = jl.System(lagrangian, ("x",))

    def angle(q0, p, tolerance):
        ts = [0.0, 1.0]
        return jl.simulate(pendulum, q0, [0.0], ts, p, rtol=tolerance, atol=1e-9).q[-1, 0]

    gradient = jax.jit(jax.grad(angle, argnums=(0, 1)))
    gradient(jnp.array([1.0]), 9.81, 1e-9)
    first = len(count)
    gradient(jnp.array([0.7]), 9.7, 1e-8)
    assert len(count) == first
    # Reverse mode traces the Lagrangian at most twice as often as the solve does.
    again = jl.System(lambda *args: lagrangian(*args), ("x",))
    del count[:]
    jax.jit(lambda q0: jl.simulate(again, q0, [0.0], [0.0, 1.0], 9.81).q[-1, 0])(jnp.array([1.0]))
    assert first <= 2 * len(count)


def test_capacity_follows_from_the_memory():
    """The times of all steps take 8 bytes each, and 5 more with knots; states take the rest."""
    state, size, steps = 4, 8, 16384
    times = 8 * steps
    assert capacity_for("auto", None, steps, 2, state, size) == 512
    capacity = capacity_for("auto", times + 10_000, steps, 2, state, size)
    assert capacity == 128
    assert needed(capacity, steps, state, size) <= times + 10_000
    assert capacity_for("auto", times, steps, 2, state, size) == 0
    assert needed(0, steps, state, size, knots=True) == 13 * steps
    assert capacity_for("recorded", None, 1000, 2, state, size) >= 1000


@pytest.mark.parametrize(
    ("ts", "dt", "knots", "most"),
    [
        ([0.0, 0.05], 0.05, None, 64),
        ([0.0, 6.2], 0.1, None, 64),
        ([6.3, 0.0], 0.1, None, 128),
        ([0.0, 1.0], 0.1, np.zeros(60), 128),
        ([0.0, 100.0], 0.1, None, 1024),
        ([0.0, 1.0], 1e-9, None, 16384),
        ([0.0, 1.0], None, None, 16384),
    ],
)
def test_fixed_steps_bound_the_record(ts, dt, knots, most):
    assert most_steps(16384, np.array(ts), dt, knots) == most
    assert most_steps(50, np.array(ts), dt, knots) == 50


@pytest.mark.full
@pytest.mark.parametrize("options", [{}, {"gradient_memory": 5000}])
def test_a_bounded_record_changes_no_digit(options):
    """The steps end at a knot and at a save time, and the last one is shorter."""
    push = jl.GeneralizedForce(lambda t, q, v, p, inputs: inputs["push"][None], name="push")
    pendulum = jl.System(
        lambda t, q, v, p: 0.5 * v[0] ** 2 + p * jnp.cos(q[0]), ("x",), forces=(push,)
    )

    def end(q0, p, ts, **options):
        inputs = {"push": jl.ZeroOrderHold([0.0, 0.13, 1.0], [1.0, -1.0, 0.0])}
        motion = jl.simulate(
            pendulum, q0, [0.0], ts, p, inputs=inputs, dt=0.1, method="heun", **options
        )
        return motion.q[-1, 0] + motion.q[1, 0], motion.gradient_mode

    at, ts = (jnp.array([1.0]), 9.81), np.array([0.0, 0.3, 0.95])
    gradient = jax.value_and_grad(end, argnums=(0, 1), has_aux=True)
    known = jax.jit(lambda q0, p: gradient(q0, p, ts, **options))
    traced = jax.jit(gradient)
    (a, modes), of_a = known(*at)
    (b, _), of_b = traced(*at, jnp.asarray(ts))
    assert a == b
    assert jax.tree.leaves(of_a) == jax.tree.leaves(of_b)
    assert jl.GradientMode(int(modes)).name == "recorded"
    assert largest(operations(known, *at, iterations=1)) < 16 * 64
    assert largest(operations(traced, *at, jnp.asarray(ts), iterations=1)) >= 16384


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"gradient": "recorded", "gradient_memory": 150_000},
            r"`gradient_memory` must be at least \d+ bytes for gradient='recorded' and "
            r"max_steps=16384, but it was 150000. Use gradient='checkpoints' \(\d+ bytes\) or "
            r"'forward' \(131072 bytes\).",
        ),
        (
            {"gradient": "checkpoints", "gradient_memory": 1000},
            r"`gradient_memory` must be at least \d+ bytes .* but it was 1000. Lower max_steps.",
        ),
        (
            {"gradient_memory": 1000},
            "`gradient_memory` must be at least 131072 bytes for max_steps=16384, but it was 1000. "
            "Lower max_steps.",
        ),
        (
            {"gradient_memory": -1},
            "`gradient_memory` must be a positive number of bytes or None, but it was -1.",
        ),
        (
            {"gradient_memory": 1e9, "method": diffrax.LeapfrogMidpoint(), "dt": 0.1},
            "`gradient_memory` must be left out for LeapfrogMidpoint, which stores every step",
        ),
    ],
)
def test_insufficient_memory_is_refused(options, message):
    free = jl.System(lambda t, q, v, p: 0.5 * v[0] ** 2, ("x",))
    with pytest.raises(ValueError, match=message):
        jl.simulate(free, [0.0], [1.0], [0.0, 1.0], **options)


def test_memory_counts_the_terms_of_work():
    push = jl.GeneralizedForce(lambda t, q, v, p: jnp.ones(1), name="push")
    system = jl.System(lambda t, q, v, p: 0.5 * v[0] ** 2, ("x",), forces=(push,))
    solve = partial(jl.simulate, system, [0.0], [1.0], [0.0, 1.0], gradient="recorded")
    assert solve(gradient_memory=400_000).status == jl.Status.ok
    with pytest.raises(ValueError, match="`gradient_memory` must be at least 524336 bytes"):
        solve(gradient_memory=400_000, save=("work",))


@pytest.mark.full
def test_an_integer_has_no_derivative():
    """JAX refuses it; an integer in params is not differentiated."""
    spring = jl.System(lambda t, q, v, p: 0.5 * v[0] ** 2 - p["k"] * q[0] ** p["n"], ("x",))

    def end(params):
        return jl.simulate(spring, [1.0], [0.0], [0.0, 0.5], params).q[-1, 0]

    with pytest.raises(TypeError, match=r"grad requires real- or complex-valued inputs"):
        jax.grad(end)({"k": 0.5, "n": 2})
    by_k = jax.grad(lambda k: end({"k": k, "n": 2}))(0.5)
    np.testing.assert_allclose(by_k, -0.5 * np.sin(0.5), rtol=1e-8)  # cos(sqrt(2 k) t)


@pytest.mark.full
def test_all_transforms_give_equal_derivatives():
    """Nested batches, gradients through scans, reverse over reverse: equal results."""
    pendulum = jl.System(lambda t, q, v, p: 0.5 * v[0] ** 2 + p * jnp.cos(q[0]), ("x",))
    p, starts = jnp.array(9.81), jnp.linspace(0.1, 1.2, 6).reshape(2, 3, 1)

    def end(q0, p):
        options = {"method": "tsit5", "dt": 0.02, "max_steps": 64, "throw": False}
        return jl.simulate(pendulum, q0, [0.3], [0.0, 0.5, 1.0], p, **options).q[1:, 0]

    def loss(q0, p):
        return jnp.sum(end(q0, p) ** 2)

    def scanned(p):
        return jax.lax.scan(lambda c, q: (c + loss(q, p), None), 0.0 * p, starts[0])[0]

    def same(a, b):
        np.testing.assert_allclose(a, b, rtol=1e-11)

    single = jax.jit(jax.grad(loss, 1))
    one_by_one = np.array([[single(q, p) for q in lane] for lane in starts])
    batch = jax.vmap(jax.vmap(jax.grad(loss, 1), (0, None)), (0, None))
    same(jax.jit(batch)(starts, p), one_by_one)
    together = jax.grad(lambda p: jnp.sum(jax.vmap(lambda q: loss(q, p))(starts[0])))
    for function in (together, jax.grad(scanned), jax.grad(jax.checkpoint(scanned))):
        same(jax.jit(function)(p), one_by_one[0].sum())
    same(jax.linearize(lambda p: loss(starts[0, 0], p), p)[1](1.0 + 0.0 * p), one_by_one[0, 0])
    same(jax.jit(jax.jacrev(end, 1))(starts[0, 0], p), jax.jit(jax.jacfwd(end, 1))(starts[0, 0], p))

    second = jax.jit(jax.hessian(loss, 1))
    curvature = np.array([second(q, p) for q in starts[0]])
    same(jax.jit(jax.vmap(jax.hessian(loss, 1), (0, None)))(starts[0], p), curvature)
    same(jax.jit(jax.grad(jax.grad(loss, 1), 1))(starts[0, 0], p), curvature[0])
    third = jax.jit(jax.jacfwd(jax.hessian(loss, 1), 1))(starts[0, 0], p)
    h = 1e-3
    by_differences = (second(starts[0, 0], p + h) - second(starts[0, 0], p - h)) / (2 * h)
    np.testing.assert_allclose(third, by_differences, rtol=1e-5)  # h^2 times the fifth derivative
