"""A solution as text, by index, as a dict, as a dataset and as a figure."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl


def plane(t, q, v, params):
    return 0.5 * v @ v - 0.5 * params * q @ q


SYSTEM = jl.System(plane, {"x": (), "y": (), "arm": (2, 2)})
TS = np.linspace(0.0, 1.0, 5)
Q0 = jnp.arange(1.0, 7.0)


def moved(stiffness, **options):
    return jl.simulate(
        SYSTEM, Q0, 0.0 * Q0, TS, stiffness, throw=False, dt=0.25, method="heun", **options
    )


@pytest.fixture(scope="module")
def motion():
    return moved(1.0)


@pytest.fixture(scope="module")
def batch():
    """The third and the fifth have NaN stiffness."""
    return jax.vmap(moved)(jnp.array([1.0, 2.0, jnp.nan, 3.0, jnp.nan]))


def test_a_motion_is_described_in_one_line(motion, batch):
    assert repr(motion) == "Solution(x, y, arm: 5 times from 0 to 1 s, ok)"
    assert repr(batch) == "Solution(x, y, arm: batch (5,) of 5 times, 3 ok, 2 nonfinite)"
    seen = []
    jax.jit(lambda k: seen.append(repr(moved(k))) or k)(1.0)
    assert seen == ["Solution(x, y, arm: 5 times, traced)"]


def test_motions_of_a_batch_are_taken_by_index(batch, motion):
    one = batch[0]
    np.testing.assert_allclose(one.q, motion.q, rtol=1e-14)
    assert one.message() == motion.message()
    np.testing.assert_array_equal(batch[1:]["x"], batch["x"][1:])
    np.testing.assert_array_equal(batch[np.array([3, 0])].energy, batch.energy[np.array([3, 0])])
    with pytest.raises(ValueError, match=r"^`name` must be a name, for a single motion, .* was 3"):
        motion[3]


def test_message_of_a_batch_counts_statuses(batch):
    first, second = batch.message().splitlines()
    assert first == "5 motions: 3 ok, 2 nonfinite"
    assert second.startswith("[2]: nonfinite")


def test_a_dict_has_everything_by_name(motion, batch):
    found = motion.to_dict()
    assert list(found) == ["t", "x", "x'", "y", "y'", "arm", "arm'"]
    assert all(isinstance(value, np.ndarray) for value in found.values())
    np.testing.assert_array_equal(found["arm'"], motion.rate("arm"))
    saved = moved(1.0, save=("energy",)).to_dict()
    np.testing.assert_allclose(saved["energy"], motion.energy, rtol=1e-14)
    assert batch.to_dict()["arm"].shape == (5, 5, 2, 2)


def test_a_dataset_is_labeled(motion, batch):
    pytest.importorskip("xarray")
    found = motion.to_xarray()
    np.testing.assert_array_equal(found["t"], TS)
    np.testing.assert_allclose(float(found["x"].sel(t=0.5)), float(motion["x"][2]))
    assert found["arm"].dims == ("t", "arm_0", "arm_1")
    many = batch.to_xarray()
    assert many["arm"].dims == ("motion", "t", "arm_0", "arm_1")
    assert many["status"].to_numpy().tolist() == batch.status.tolist()
    # Different times are not a common coordinate.
    own = jax.vmap(
        lambda end: jl.simulate(
            SYSTEM, Q0, 0.0 * Q0, jnp.array([0.0, 0.5, 1.0]) * end, 1.0, dt=0.25, method="heun"
        )
    )(jnp.array([1.0, 2.0]))
    assert own.to_xarray()["t"].dims == ("motion", "save")


def test_a_figure_shows_coordinates_energy_and_paths(motion, batch):
    """The data of the lines, not their style."""
    pytest.importorskip("matplotlib")
    *panels, plane = motion.plot().axes
    assert [ax.get_ylabel() for ax in panels] == ["x", "y", "arm", "energy [J]"]
    np.testing.assert_array_equal(panels[0].lines[0].get_ydata(), motion["x"])
    assert len(panels[2].lines) == 4
    paths = [line.get_xydata() for line in plane.lines[::2]]
    np.testing.assert_array_equal(paths[0], np.stack([motion["x"], motion["y"]], axis=1))
    np.testing.assert_array_equal(paths[1], motion["arm"][:, 0])
    np.testing.assert_array_equal(paths[2], motion["arm"][:, 1])
    assert len(batch.plot().axes[0].lines) == 5


def test_a_name_with_a_prime_is_a_velocity(motion, batch):
    """As in `to_dict`."""
    np.testing.assert_array_equal(motion["arm'"], motion.rate("arm"))
    np.testing.assert_array_equal(batch["x'"], batch.rate("x"))
    with pytest.raises(ValueError, match=r"`name` must be one of .*, but it was \"z'\""):
        motion["z'"]


@pytest.mark.parametrize(
    ("name", "ours"),
    [("ys", "motion.q and motion.v"), ("evaluate", r"motion.at\(t\)"), ("qpos", "motion.q")],
)
def test_attributes_of_other_tools_are_told_ours(motion, name, ours):
    with pytest.raises(AttributeError, match=f"no attribute '{name}'. Write {ours}"):
        getattr(motion, name)


def test_input_values_are_those_that_forces_read():
    """Tables, functions of time and feedback, at the save times; the inputs stay as they were."""

    def torque(t, q, v, params, inputs):
        return jnp.stack([inputs["table"] + inputs["wave"], inputs["control"] @ jnp.ones(2)])

    system = jl.System(
        lambda t, q, v, p: 0.5 * v @ v, ("x", "y"), forces=(jl.GeneralizedForce(torque, "motor"),)
    )
    inputs = {
        "wave": jl.TimeFunction(lambda t, p: jnp.sin(t)),
        "table": jl.LinearInterpolation([0.0, 2.0], [1.0, 3.0]),
        "control": jl.Feedback(lambda t, q, v, p: -q - v),
    }
    motion = jl.simulate(
        system, [1.0, 0.0], [0.0, 0.5], TS, inputs=inputs, dt=0.25, method="heun",
        save=("input_values",),
    )  # fmt: skip
    assert list(motion.input_values) == sorted(inputs)
    assert isinstance(motion.inputs["table"], jl.LinearInterpolation)
    found = motion.input_values
    np.testing.assert_allclose(found["wave"], np.sin(TS), rtol=1e-15)
    np.testing.assert_allclose(found["table"], 1.0 + TS, rtol=1e-15)
    np.testing.assert_allclose(found["control"], -motion.q - motion.v, rtol=1e-15)
    with pytest.raises(KeyError, match=r"one of \['control', 'table', 'wave'\], .* Write 'table'"):
        found["tables"]


def test_a_quasi_velocity_may_have_a_prime_in_its_name():
    def speeds(t, q, v, p):
        return jnp.stack([2.0 * v[0], v[1]])

    system = jl.System(
        lambda t, q, v, p: 0.5 * v @ v, ("x", "y"), quasi=jl.QuasiVelocities(speeds, ("x'", "w"))
    )
    motion = jl.simulate(system, [0.0, 0.0], [1.0, 3.0], [0.0, 1.0], dt=0.5, method="heun")
    np.testing.assert_allclose(motion["x'"], 2.0)
    np.testing.assert_allclose(motion["y'"], 3.0)
    with pytest.raises(ValueError, match=r"one of \['x', 'y', \"x'\", 'w'\], but it was \"w'\""):
        motion["w'"]
