"""Errors inside functions of the user: the message names the function, the line and a fix."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag._tracing._user_errors import translate

PARAMS = {"m": 1.0, "k": 2.0}


def good(t, q, v, params):
    return 0.5 * params["m"] * v[0] ** 2 - 0.5 * params["k"] * q[0] ** 2


def with_numpy(t, q, v, params):
    return 0.5 * v[0] ** 2 + np.cos(q[0])


def with_float(t, q, v, params):
    return 0.5 * v[0] ** 2 + float(q[0])


def with_choice(t, q, v, params):
    return 0.5 * v[0] ** 2 - (q[0] if q[0] > 0 else 2.0 * q[0])


def with_index(t, q, v, params):
    return 0.5 * v[0] ** 2 - [1.0, 2.0][q[0].astype(int)]


def pulled(t, q, v, params, lam):
    return lam["rood"] * q


def run(lagrangian=good, params=PARAMS, **options):
    system = jl.System(lagrangian, ("x",), **options)
    return jl.simulate(system, [1.0], [0.0], [0.0, 1.0], params, dt=0.5, method="heun")


ROD = jl.Holonomic(lambda t, q, params: q[0] ** 2 - 1.0, "rod")
WRONG = {
    "numpy": (
        lambda: run(with_numpy),
        r"^function 'with_numpy' must compute with jax.numpy, but line \d+ \(`return .*np.cos",
    ),
    "float": (lambda: run(with_float), r"^function 'with_float' must keep traced .* Leave out"),
    "choice": (lambda: run(with_choice), r"^function 'with_choice' must choose .*jnp.where"),
    "index": (lambda: run(with_index), r"^function 'with_index' must index .*jnp.take"),
    "missing": (
        lambda: run(params={"m": 1.0}),
        r"^`params` must have an entry 'k', which function 'good' reads, but its names were",
    ),
    "none": (
        lambda: run(params=None),
        r"^`params` must be given, since function 'good' reads them",
    ),
    "text": (
        lambda: run(params={"m": "1", "k": 2.0}),
        r"^`params\['m'\]` must be a number where function 'good' calculates .* the text '1'",
    ),
    "row": (
        lambda: run(
            constraints=(ROD,), forces=(jl.GeneralizedForce(pulled, "pull", reaction=True),)
        ),
        r"^`lam` must have an entry 'rood', .* its names were \['rod'\]",
    ),
}


@pytest.mark.parametrize("kind", WRONG)
def test_common_mistakes_are_named(kind):
    make, message = WRONG[kind]
    with pytest.raises(ValueError, match=message) as caught:
        make()
    assert caught.value.__cause__ is not None  # the original error stays visible


def test_other_errors_are_unchanged():
    """Errors raised by the user, and errors other than missing keys."""

    def own(t, q, v, params):
        raise RuntimeError("mine")

    with pytest.raises(RuntimeError, match="mine"):
        run(own)
    assert translate(good, [0.0, [1.0], [0.0], PARAMS], KeyError("m")) is None
    assert translate(good, [0.0, [1.0], [0.0], PARAMS], TypeError("other")) is None


def test_derivatives_give_the_same_message():
    """The message does not mention tracers."""

    def end(m):
        return run(params={"m": m}).q[-1, 0]

    with pytest.raises(ValueError, match=r"have an entry 'k'") as caught:
        jax.grad(end)(1.0)
    assert "racer" not in str(caught.value)


class Model(eqx.Module):
    k: jax.Array

    def __call__(self, t, q, v, params):
        return 0.5 * v[0] ** 2 - 0.5 * self.k * q[0] ** 2

    def energy(self, t, q, v, params):
        return self(t, q, v, params)


def test_modules_with_arrays_belong_into_params():
    """Refused as functions, with advice; as params they work, derivatives included."""
    model = Model(jnp.array(2.0))
    for function in (model, model.energy):
        with pytest.raises(ValueError, match=r"holds arrays\. Put the module into params"):
            jl.System(function, ("x",))

    def lagrangian(t, q, v, params):
        return params["model"](t, q, v, params)

    system = jl.System(lagrangian, ("x",))

    @eqx.filter_grad
    def slope(model):
        params = {"model": model}
        return jl.simulate(system, [1.0], [0.0], [0.0, 1.0], params, method="tsit5").q[-1, 0]

    w = np.sqrt(2.0)
    np.testing.assert_allclose(slope(model).k, -np.sin(w) / (2 * w), rtol=1e-6)
