"""The form of errors: names in back-ticks, long arrays shortened, quoted text as it is."""

import numpy as np
import pytest

import jaxlag as jl
from jaxlag._core._errors import invalid, shortened, unsupported


@pytest.mark.parametrize(
    ("argument", "shown"),
    [
        ("rtol", "`rtol`"),
        ("rtol and atol", "`rtol` and `atol`"),
        ("params['a'][0].law", "`params['a'][0].law`"),
        ("lyapunov: motion", "lyapunov: `motion`"),
        ("force 'drag'", "force 'drag'"),
        ("force 'drag': Q", "force 'drag': `Q`"),
        ("names of the inputs", "names of the inputs"),
    ],
)
def test_argument_names_are_in_back_ticks(argument, shown):
    error = invalid(argument, "be finite", "it was nan", "Leave it out.")
    assert str(error) == f"{shown} must be finite, but it was nan. Leave it out."


def test_unsupported_states_the_reason_and_a_fix():
    error = unsupported("`at` of a batch", "its shape is (2,)", "Take one of them.")
    assert str(error) == "`at` of a batch is not supported: its shape is (2,). Take one of them."


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        (f"it was {np.arange(8)}", "it was [0 1 2 3 4 5 6 7]"),
        (f"it was {np.arange(9)} m", "it was [0, 1, 2, ..., 6, 7, 8] (9 numbers) m"),
        (f"q = {np.arange(9.0)}, v", "q = [0., 1., 2., ..., 6., 7., 8.] (9 numbers), v"),
        (str(np.full((3, 4), np.nan)), "[nan, nan, nan, ..., nan, nan, nan] (12 numbers)"),
        ("[[1, 2, 3], [4, 5, 6]] and [7, 8, 9]", "[[1, 2, 3], [4, 5, 6]] and [7, 8, 9]"),
        (
            "line 3 (`a = [1, 2, 3, 4, 5, 6, 7, 8, 9]`)",
            "line 3 (`a = [1, 2, 3, 4, 5, 6, 7, 8, 9]`)",
        ),
        ("it was '[1, 2, 3, 4, 5, 6, 7, 8, 9]'", "it was '[1, 2, 3, 4, 5, 6, 7, 8, 9]'"),
        ("among ['a', 'b', 'c', 'd', 'e', 'f', 'g', 'h', 'i']",) * 2,
        ("left [ open 1 2 3 4 5 6 7 8 9",) * 2,
    ],
)
def test_long_arrays_are_shortened(text, shown):
    assert shortened(text) == shown


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("it was JitTracer(float64[])", "it was a traced float64[]"),
        (
            "GradTracer(primal=1.0, typeof(tangent)=f64[]), or (1)",
            "a traced f64[], or (1)",
        ),
        (
            "{'a': JVPTracer(primal=JitTracer(float32[2,3]), tangent=JitTracer(float32[2,3]))}",
            "{'a': a traced float32[2,3]}",
        ),
        ("MyTracer(", "a traced value"),
    ],
)
def test_traced_values_are_shown_by_their_shapes(text, shown):
    assert shortened(text) == shown


@pytest.mark.parametrize("piece", ["[", "[1 ", "[1     ", "1 ", "]"])
def test_unclosed_brackets_stay_unchanged(piece):
    assert shortened(piece * 10_000) == piece * 10_000


@pytest.mark.full
def test_messages_of_results_shorten_their_states():
    n = 12
    system = jl.System(lambda t, q, v, p: 0.5 * v @ v, {"x": n})
    motion = jl.simulate(
        system,
        np.ones(n),
        np.zeros(n),
        [0.0, 1.0],
        max_steps=1,
        dt=0.1,
        throw=False,
        method="euler",
    )
    assert "q = [1., 1., 1., ..., 1., 1., 1.] (12 numbers), v = [0., 0." in motion.message()
    rest = jl.equilibrium(jl.System(lambda t, q, v, p: 0.5 * v @ v - q @ q, {"x": n}), np.zeros(n))
    assert "q = [0., 0., 0., ..., 0., 0., 0.] (12 numbers) after" in rest.message()
    near = jl.assemble(system, np.ones(n), np.zeros(n))
    assert "(12 numbers), rank 0" in near.message()
