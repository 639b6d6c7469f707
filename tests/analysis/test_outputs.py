"""Outputs of linearized equations: labels, and what is refused."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl

ROD = jl.System(
    lambda t, q, v, p: 0.5 * v @ v - 9.81 * q[2],
    {"r": (3,)},
    constraints=(jl.Holonomic(lambda t, q, p: q @ q - 1.0, "rod"),),
)
AT = [0.6, 0.48, -0.64], [0.0, 0.0, 0.0]


@pytest.mark.full
def test_labels_and_values():
    def height(t, q, v, p):
        return q[2]

    outputs = {"tip": "r", "speed": "r'", "first": "r[0]", "pull": "rod", "z": height}
    linear = jl.linearize(ROD, *AT, outputs=outputs)
    tips = tuple(f"{name}[{i}]" for name in ("tip", "speed") for i in range(3))
    assert linear.outputs == (*tips, "first", "pull", "z")
    lam = ROD.multipliers(*AT)["rod"]
    np.testing.assert_allclose(linear.y0, [*AT[0], *AT[1], 0.6, lam, -0.64], rtol=1e-14)
    np.testing.assert_allclose(linear.C[2], linear.C[-1])
    names = ("r[1]'", "rod", height, lambda t, q, v, p: v)
    found = jl.linearize(ROD, *AT, outputs=names)
    assert found.outputs == ("r[1]'", "rod", "height", *(f"outputs[3][{i}]" for i in range(3)))


@pytest.mark.full
def test_quantities_of_constrained_quasi_velocities_are_multipliers():
    def along(t, q, v, p):
        return jnp.stack([v[0] + q[1] * v[1], v[1] - q[0] * v[0]])

    quasi = jl.QuasiVelocities(along, ("u", "w"), ("w",))
    system = jl.System(lambda t, q, v, p: 0.5 * v @ v - q[1], ("x", "y"), quasi=quasi)
    at = [0.5, 0.2], [0.4, 0.2]
    linear = jl.linearize(system, *at, outputs=("u", "w"))
    lam = system.multipliers(*at)["w"]
    np.testing.assert_allclose(linear.y0, [0.4 + 0.2 * 0.2, lam], rtol=1e-14)
    assert abs(lam) > 0.1


@pytest.mark.parametrize(
    ("outputs", "text"),
    [
        ("r", r"`outputs` must be a sequence of names and functions, or a dict.* it was 'r'"),
        (("speed",), r"must hold functions and names among \['r', 'r\[0\]'.*one was 'speed'"),
        ((3,), r"must hold functions and names .*one was 3"),
        (("r", "r[1]"), r"must have names of their own, but two were 'r\[1\]'"),
        ({"": "r"}, r"must have names as keys, but one was ''"),
        ((lambda t, q, v: q,), r"`outputs\[0\]` must be callable as \(t, q, v, params\)"),
        ({"y": lambda t, q, v, p: q > 0}, r"`outputs\['y'\]` must return real numbers.*bool"),
        ({"y": lambda t, q, v, p: q / (q[0] - 0.6)}, r"finite values and derivatives.*'y\[0\]'"),
    ],
)
def test_bad_outputs_are_refused(outputs, text):
    with pytest.raises(ValueError, match=text):
        jl.linearize(ROD, *AT, outputs=outputs)


def test_names_of_two_quantities_are_refused():
    row = jl.Holonomic(lambda t, q, p: q[1], "x")
    shadowed = jl.System(lambda t, q, v, p: 0.5 * v @ v, ("x", "y"), constraints=(row,))
    text = r"name one quantity each, but 'x' was the name of a coordinate and a multiplier"
    with pytest.raises(ValueError, match=text):
        jl.linearize(shadowed, [5.0, 0.0], [0.0, 0.0], outputs=("x",))
