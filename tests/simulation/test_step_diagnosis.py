"""Solution.explain: what limits the steps."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from systems.catalogue import ENTRIES


def pendulum(t, q, v, params):
    return 0.5 * v[0] ** 2 + params["g"] * jnp.cos(q[0])


def bob(t, q, v, params):
    return 0.5 * (v @ v) - params["g"] * q[1]


def rod(t, q, params):
    return q @ q - 1.0


ANGLE = jl.System(pendulum, ("theta",))
BOB = jl.System(bob, ("x", "y"), constraints=(jl.Holonomic(rod, "rod"),))
TS = np.linspace(0.0, 2.0, 9)


def line(text: str, head: str) -> str:
    (found,) = [x[14:] for x in text.splitlines() if x[:14].rstrip() == head]
    return found


def test_normal_motion_is_described():
    """At the bottom the rate is sqrt g: its period 2 pi / 3 and steps per period are stated."""
    motion = jl.simulate(ANGLE, [1e-3], [0.0], TS, {"g": 9.0})
    text = motion.explain()
    h = 2.0 / int(motion.stats["accepted"])
    assert line(text, "method") == "nystrom12, rtol 1e-09, atol 1e-09, multipliers"
    assert line(text, "rates") == (
        f"fastest oscillation of period 2.09 s, {2 * np.pi / 3 / h:.3g} steps each"
    )
    assert line(text, "mass matrix") == "cond(M) up to 1 with its diagonal scaled to 1"
    assert line(text, "advice").startswith("Accuracy limits the step")
    assert "projection" not in text


@pytest.mark.full
def test_projection_is_described():
    text = jl.simulate(BOB, [1.0, 0.0], [0.0, 0.0], TS, {"g": 9.0}).explain()
    assert line(text, "projection") in (
        "up to 1 iteration per step",
        "up to 2 iterations per step",
    )
    unprojected = jl.simulate(BOB, [1.0, 0.0], [0.0, 0.0], TS, {"g": 9.0}, stabilization=None)
    assert "projection" not in unprojected.explain()
    far = jl.simulate(
        BOB, [1.0, 0.0], [0.0, 0.0], TS, {"g": 9.0}, method="tsit5", dt=0.6, throw=False
    )
    text = far.explain()  # a step of half a revolution
    iterations = int(line(text, "projection").split()[2])
    assert iterations > 3
    advice = line(text, "advice")
    assert f"onto the constraints takes up to {iterations} iterations" in advice


def test_jumping_force_gets_advice_on_rejected_steps():
    def push(t, q, v, params, inputs):
        return jnp.sign(jnp.sin(40.0 * t))[None]

    system = jl.System(pendulum, ("theta",), forces=(jl.GeneralizedForce(push, name="push"),))
    text = jl.simulate(system, [0.3], [0.0], TS, {"g": 9.0}).explain()
    assert "Many steps were rejected" in line(text, "advice")


@pytest.mark.full
def test_a_mass_matrix_near_singular_names_a_coordinate():
    """Masses of 1e-10 in their own units cost no digits; nearly equal velocities do."""

    def light(t, q, v, params):
        return 0.5 * v[0] ** 2 + 0.5e-10 * v[1] ** 2 - 0.5 * q[0] ** 2 - 0.5e-10 * q[1] ** 2

    motion = jl.simulate(jl.System(light, ("cart", "mote")), [1.0, 1.0], [0.0, 0.0], TS, {})
    assert line(motion.explain(), "mass matrix") == "cond(M) up to 1 with its diagonal scaled to 1"

    def alike(t, q, v, params):
        both, difference = v[0] + v[1], v[0] - v[1]
        return 0.5 * both**2 + 0.5e-10 * difference**2 - 0.5 * q[0] ** 2 - 0.5 * q[1] ** 2

    motion = jl.simulate(jl.System(alike, ("a", "b")), [1e-3, 1e-3], [0.0, 0.0], TS, {})
    text = motion.explain()
    assert line(text, "mass matrix") == "cond(M) up to 1e+10 with its diagonal scaled to 1"
    assert "M is nearly singular, as along 'a': accelerations are accurate to about 6" in text


@pytest.mark.full
def test_massless_link_is_described():
    def lead(t, q, v, params):
        return 0.5 * v[0] ** 2 - 0.5 * q[0] ** 2

    tie = jl.Holonomic(lambda t, q, p: q[0] - q[1], "tie")
    system = jl.System(lead, ("x", "y"), constraints=(tie,))
    text = jl.simulate(system, [1.0, 1.0], [0.0, 0.0], TS, {}).explain()
    assert line(text, "mass matrix") == "no inertia of its own along 'y'"


def test_growth_is_described_by_its_rate():
    """Upright, the rates are +- sqrt g."""
    text = jl.simulate(ANGLE, [np.pi - 1e-6], [0.0], TS, {"g": 9.0}).explain()
    assert line(text, "rates").startswith("fastest growth e-fold in 0.333 s")


def test_implicit_steps_are_limited_by_accuracy():
    def uncoupled(t, q, v, params):
        return 0.5 * (v @ v) - 0.5 * q[0] ** 2 - 0.5e8 * q[1] ** 2

    motion = jl.simulate(
        jl.System(uncoupled, ("calm", "quick")), [1.0, 0.0], [0.0, 0.0], TS, {}, method="kvaerno5"
    )
    text = motion.explain()
    assert line(text, "advice").startswith("Accuracy limits the step")
    assert "error  " not in text


def test_the_component_with_the_largest_error_is_named():
    def uncoupled(t, q, v, params):
        return 0.5 * (v @ v) - 0.5 * q[0] ** 2 - 0.5e4 * q[1] ** 2

    motion = jl.simulate(jl.System(uncoupled, ("calm", "quick")), [1.0, 1.0], [0.0, 0.0], TS, {})
    assert line(motion.explain(), "error").startswith(
        "largest, relative to its tolerance, in d(quick)/dt"
    )


def test_stopped_motion_is_described_by_its_progress():
    motion = jl.simulate(ANGLE, [1.0], [0.0], TS, {"g": 9.0}, max_steps=7, throw=False)
    part = float(motion.last_time) / 2.0
    advice = line(motion.explain(), "advice")
    assert f"reached {part:.1%} of ts: the whole of ts takes about {7 / part:.2g} steps" in advice


def test_motion_without_a_step_is_described():
    nowhere = jl.System(lambda t, q, v, params: 0.5 * v[0] ** 2 + jnp.log(q[0]), ("x",))
    motion = jl.simulate(nowhere, [-1.0], [0.0], TS, throw=False)
    assert line(motion.explain(), "steps") == "0 attempted, 0 rejected"


@pytest.mark.parametrize("method", ["gauss4", "tsit5"])
def test_explanation_of_fixed_steps_mentions_no_tolerance(method):
    """A decay of 3 per step limits explicit steps, not implicit ones."""
    slow = jl.System(
        lambda t, q, v, params: 0.5 * v[0] ** 2 - 0.5 * q[0] ** 2,
        ("x",),
        forces=(jl.Rayleigh(lambda t, q, v, params: 0.5 * params * v[0] ** 2, "rayleigh"),),
    )
    text = jl.simulate(slow, [1.0], [0.0], TS, 300.0, method=method, dt=0.008).explain()
    assert "tolerance" not in text
    assert ("It is stiff" in text) == (method == "tsit5")
    calm = jl.simulate(slow, [1.0], [0.0], TS, 3.0, method=method, dt=0.008).explain()
    assert line(calm, "advice").startswith("dt alone sets the number of steps")


def test_resolution_of_times_far_from_zero_is_described():
    """1e9 s has digits of 1e-7 s: a force that depends on time is a staircase there."""
    force = jl.GeneralizedForce(lambda t, q, v, p: jnp.cos(1.3 * (t - p))[None], "shaken")
    shaken = jl.System(
        lambda t, q, v, p: 0.5 * v[0] ** 2 - 0.5 * q[0] ** 2, ("x",), forces=(force,)
    )
    options = {"rtol": 1e-12, "atol": 1e-12, "max_steps": 200, "throw": False}
    late = jl.simulate(shaken, [1.0], [0.0], 1e9 + TS, 1e9, **options)
    assert late.status == jl.Status.max_steps
    message = "Times near 1e+09 s are 2.2e-07 s apart"
    assert message in late.message()
    assert message in late.explain()
    early = jl.simulate(shaken, [1.0], [0.0], TS, 0.0, **options)
    assert "apart" not in early.explain()


# ---- Advice in messages --------------------------------------------------------------------------


def test_messages_for_fixed_steps_mention_no_tolerance():
    stopped = jl.simulate(ANGLE, [1.0], [0.0], TS, {"g": 9.0}, dt=1e-3, max_steps=7, throw=False)
    assert "max_steps" in stopped.message()
    assert "lengthen dt" in stopped.message()
    quartic = jl.System(lambda t, q, v, params: 0.5 * v[0] ** 2 + q[0] ** 4, ("x",))
    away = jl.simulate(quartic, [1.0], [3.0], [0.0, 10.0], dt=0.5, method="tsit5", throw=False)
    assert away.status == jl.Status.nonfinite
    assert "whether dt is short" in away.message()
    assert "tol" not in stopped.message() + away.message()


def test_stiff_motion_is_described():
    """Its decay rate and a method are stated, but not if steps are many for another reason."""

    def sticky(t, q, v, params):
        return 0.5 * params * v[0] ** 2

    slow = jl.System(
        lambda t, q, v, params: 0.5 * v[0] ** 2 - 0.5 * q[0] ** 2,
        ("x",),
        forces=(jl.Rayleigh(sticky, "rayleigh"),),
    )
    stiff = jl.simulate(
        slow, [1.0], [0.0], [0.0, 100.0], 1e4, method="dopri8", max_steps=200, throw=False
    )
    message = r"stiff: a component decays at 1e\+04 1/s.*method='kvaerno5'"
    assert re.search(message, stiff.message())
    quick = jl.simulate(ANGLE, [1.0], [0.0], TS, {"g": 9.0}, max_steps=7, throw=False)
    assert "stiff" not in quick.message()


def test_zero_absolute_tolerance_with_a_zero_component_is_named():
    system = jl.System(lambda t, q, v, params: 0.5 * v @ v - q[0], ("x", "y"))
    motion = jl.simulate(
        system, [1.0, 0.0], [0.5, 0.0], [0.0, 1.0], rtol=1e-6, atol=0.0, throw=False
    )
    assert motion.status == jl.Status.step_below_resolution
    assert "With atol = 0 no error is small enough" in motion.message()
    assert "component is 0, here y, y': give" in motion.message()


@pytest.mark.full
def test_quasi_velocities_are_named():
    entry = ENTRIES["chaplygin_sleigh"]
    example = entry.example
    motion = jl.simulate(
        entry.system, example.q0, example.v0, [0.0, 1.0], dict(example.params), formulation="quasi"
    )
    quasi = entry.system.quasi
    names = [*entry.coordinates, *(quasi.names[i] for i in quasi.free)]
    message = line(motion.explain(), "error").split(" in ")[1].split(" (")[0]
    assert message in names


@pytest.mark.full
def test_explain_of_batches_and_traces_is_refused():
    def solve(q0):
        return jl.simulate(ANGLE, q0, [0.0], TS, {"g": 9.0})

    batch = jax.vmap(solve)(jnp.array([[0.1], [0.2]]))
    with pytest.raises(ValueError, match=r"^`explain` of a batch is not supported: its shape is"):
        batch.explain()
    for transform in (jax.jit, jax.grad):
        with pytest.raises(ValueError, match="inside jit or vmap is not supported"):
            transform(lambda q0: len(solve(q0).explain()) * 1.0)(jnp.array([0.1]))
