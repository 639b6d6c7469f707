"""Frequency responses, Bode diagrams and python-control from linearized equations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl

EPS = np.finfo(float).eps
M, C, K = 2.0, 0.3, 18.0


def oscillator(k=K):
    """m x'' + c x' + k x = F, with the output x and the force of the wall."""

    def forces(t, q, v, p, inputs):
        return inputs["F"] - C * v

    return jl.linearize(
        jl.System(
            lambda t, q, v, p: 0.5 * M * v[0] ** 2 - 0.5 * p * q[0] ** 2,
            ("x",),
            forces=[jl.GeneralizedForce(forces, "push")],
        ),
        [0.0],
        [0.0],
        k,
        inputs=("F",),
        outputs={"x": "x", "wall": lambda t, q, v, p: p * q[0] + C * v[0], "a": "x'"},
    )


@pytest.fixture(scope="module")
def linear():
    return oscillator()


def test_frequency_response_of_an_oscillator(linear):
    """G = 1 / (k - m w^2 + i c w), and i w G for the velocity; any shape of w."""
    w = np.array([[0.5, 1.0], [3.0, 40.0]])
    found = linear.frequency_response(w)
    exact = 1.0 / (K - M * w**2 + 1j * C * w)
    np.testing.assert_allclose(found[..., 0, 0], exact, rtol=50 * EPS)
    np.testing.assert_allclose(found[..., 1, 0], (K + 1j * C * w) * exact, rtol=50 * EPS)
    np.testing.assert_allclose(found[..., 2, 0], 1j * w * exact, rtol=50 * EPS)
    one = linear.frequency_response(3, inputs=("F",), outputs=("a",))
    assert one.shape == (1, 1)
    np.testing.assert_allclose(one[0, 0], found[1, 0, 2, 0], rtol=10 * EPS)


def test_derivatives_and_batches_of_responses(linear):
    """d|G|/dk in both modes against the closed form; a batch over k."""
    w = 2.0

    def size(k):
        return jnp.abs(oscillator(k).frequency_response(w)[0, 0])

    real = K - M * w**2
    expected = -real / (real**2 + (C * w) ** 2) ** 1.5
    for mode in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(jax.jit(mode(size))(K), expected, rtol=100 * EPS)
    batch = jax.vmap(oscillator)(jnp.array([K, 2 * K]))
    found = batch.frequency_response([1.0, w])
    assert found.shape == (2, 2, 3, 1)
    np.testing.assert_allclose(found[0, 1], linear.frequency_response(w), rtol=20 * EPS)


def test_bode_diagram(linear):
    figure = linear.plot()
    amplitude, phase = figure.axes
    x, y = amplitude.lines[0].get_data()
    np.testing.assert_allclose(y, np.abs(linear.frequency_response(x)[:, 0, 0]), rtol=20 * EPS)
    assert (x[0], x[-1]) == pytest.approx((0.3, 30.0))  # sqrt(k / m) = 3
    assert [text.get_text() for text in amplitude.get_legend().texts][:2] == ["x by F", "wall by F"]
    assert phase.lines[0].get_ydata()[-1] == pytest.approx(-180.0, abs=1.0)


def test_python_control(linear):
    pytest.importorskip("control")
    model = linear.to_control()
    assert model.state_labels == ["x", "x'"]
    assert model.input_labels == ["F"]
    assert model.output_labels == ["x", "wall", "a"]
    for name in "ABCD":
        np.testing.assert_array_equal(getattr(model, name), getattr(linear, name))
    found = linear.frequency_response([1.0, 4.0])
    for w, each in zip((1.0, 4.0), found, strict=True):
        np.testing.assert_allclose(each, model(1j * w, squeeze=False), rtol=100 * EPS)


def test_python_control_without_inputs_or_outputs():
    """All states are outputs; a moving cyclic coordinate is a steady motion, falling is not."""
    pytest.importorskip("control")
    free = jl.System(lambda t, q, v, p: 0.5 * v @ v - p * q[1], ("x", "y"))
    model = jl.linearize(free, [0.0, 0.0], [1.0, 0.0], 0.0).to_control()
    assert model.output_labels == ["x", "y", "x'", "y'"]
    assert model.ninputs == 0
    falling = jl.linearize(free, [0.0, 0.0], [0.0, 0.0], 9.81)
    with pytest.raises(ValueError, match=r"steady motion, but the rate of \"y'\" was -9.81"):
        falling.to_control()
    swinging = jl.System(lambda t, q, v, p: 0.5 * v @ v + jnp.sum(jnp.cos(q)), ("theta",))
    passing = jl.linearize(swinging, [np.pi / 4], [3.0])
    with pytest.raises(ValueError, match=r"steady motion, but the rate of \"theta'\" was -0.7"):
        passing.to_control()
    passing = jl.linearize(swinging, [0.0], [3.0])
    with pytest.raises(ValueError, match=r"steady motion, but the rate of f0 of \"theta'\" was -3"):
        passing.to_control()
    outputs = {"a.b": "theta"}
    resting = jl.linearize(swinging, [0.0], [0.0], outputs=outputs)
    with pytest.raises(ValueError, match=r"its names have no '\.', as 'a\.b' has"):
        resting.to_control()


def test_refusals(linear):
    with pytest.raises(ValueError, match=r"`inputs` must be names among \['F'\], but one was 'G'"):
        linear.frequency_response(1.0, inputs=("G",))
    with pytest.raises(ValueError, match=r"`outputs` must be a sequence of names"):
        linear.frequency_response(1.0, outputs="x")
    with pytest.raises(ValueError, match=r"`w` must be real"):
        linear.frequency_response(1.0j)
    for w in (3.0, [[1.0, 2.0]], [], [-1.0, 1.0], [3.0, 1.0], [np.nan, 1.0]):
        with pytest.raises(ValueError, match=r"`w` must be positive and ascending"):
            linear.plot(w)
    with pytest.raises(ValueError, match=r"`plot` is not supported: A is not finite"):
        jax.tree.map(lambda x: x * jnp.nan, linear).plot()
    batch = jax.tree.map(lambda x: jnp.stack([x, x]), linear)
    with pytest.raises(ValueError, match=r"`plot` of a batch"):
        batch.plot()
    with pytest.raises(ValueError, match=r"`to_control` of a batch"):
        batch.to_control()
    system = jl.System(lambda t, q, v, p: 0.5 * v @ v, ("x",))
    with pytest.raises(ValueError, match=r"there are no inputs"):
        jl.linearize(system, [0.0], [0.0]).plot()
