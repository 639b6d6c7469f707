"""Wrong derivatives: modes compared with each other and with differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _checked import Q, check, file_of, here, line_of, places, right, rule_of
from jax import lax

import jaxlag as jl
from jaxlag.testing._compare_modes import _quotient, step
from tests._user import unchecked  # noqa: F401


@jax.custom_jvp
def right_once(x):
    return right(x)


@right_once.defjvp
def right_once_rule(primals, tangents):
    (x,), (dx,) = primals, tangents
    return right_once(x), -1.001 * (2 * jnp.cos(x) - x * jnp.sin(x)) * -dx


@pytest.mark.parametrize(
    ("derivative", "order"),
    [(right, None), (lambda x: 1.00001 * right(x), 1), (lambda x: -right(x), 1), (right_once, 2)],
)
def test_wrong_custom_rules_are_named(derivative, order):
    """The lowest wrong order is named, even if it is wrong by one part in 10^5."""
    function = rule_of(derivative)
    report = check(lambda q, params: function(q[0]) + q[1])
    assert report.ok == (order is None)
    for finding in report.findings:
        assert (finding.kind, finding.order, finding.function) == ("wrong", order, "lagrangian")
        assert "difference quotient" in finding.hint
    if order:
        assert places(report) == here("custom_jvp_call", rule_of, "@jax.custom_jvp")
        assert {"given", "random 1", "random 2", "random 3"} == {f.state for f in report.findings}


def test_wrong_rule_among_several_names_all():
    """The wrong one cannot be identified: all are named."""
    fine, wrong = rule_of(right), rule_of(lambda x: 2.0 * right(x))
    (finding, *_) = check(lambda q, params: fine(q[0]) + right_once(q[1]) + wrong(q[1])).findings
    assert (finding.kind, finding.order, finding.primitive) == ("wrong", 1, "")
    for rule in (rule_of, right_once):
        place = f"{file_of(rule)}:{line_of(rule, '@jax.custom_jvp')}"
        assert place in finding.hint


def test_a_rule_that_is_not_finite_is_named_where_it_is_used():
    def potential(q, params):
        return q[1] + root(q[0] ** 2)  # wrong

    @jax.custom_jvp
    def root(x):
        return jnp.sqrt(x)

    root.defjvp(lambda primals, tangents: (root(primals[0]), tangents[0] / (2 * root(primals[0]))))
    report = check(potential)
    assert places(report) == here("custom_jvp_call", potential, "# wrong")


@pytest.mark.parametrize("factor", [1.0, 1.001])
def test_custom_vjp_rules_are_checked(factor):
    @jax.custom_vjp
    def function(x):
        return jnp.sin(x)

    function.defvjp(lambda x: (jnp.sin(x), x), lambda x, dy: (factor * jnp.cos(x) * dy,))
    report = check(lambda q, params: function(q[0]))
    assert report.ok == (factor == 1.0)
    assert not report.omitted  # forward ones follow from the rule
    assert {(f.kind, f.order) for f in report.findings} <= {("wrong", 1)}


@pytest.mark.parametrize("factor", [1.0, 1.001])
def test_forward_and_reverse_derivatives_disagree(factor):
    def solved(q, params):
        def solve(matvec, b):
            return b / 2.0

        def transpose_solve(vecmat, b):
            return factor * b / 2.0

        return jnp.sum(lax.custom_linear_solve(lambda x: 2.0 * x, q**2, solve, transpose_solve))

    report = check(solved)
    assert report.ok == (factor == 1.0)
    for finding in report.findings:
        assert (finding.kind, finding.order, finding.mode) == ("wrong", 1, "reverse")
        assert "forward" in finding.hint


def test_kinks_and_jumps_are_not_findings():
    """At the given state, on the kink; functions of different smoothness."""

    def potential(q, params):
        x, y = q[0] - 0.8, q[1] - 0.6
        kinks = jnp.abs(x) + jnp.where(y > 0, y, 0.0) + jnp.maximum(x, 0.0) ** 2
        return kinks + jnp.where(x > 0, x**3, x**2) + jl.math.norm(q - jnp.array(Q))

    assert check(potential).ok


def test_extrapolated_quotients_have_an_error_bound():
    """Exact for cubics; `error_bound` covers a jump and a kink, and is nearly 0 for smooth f."""

    def around(f, x):
        h = step(np.finfo(float).eps)
        return _quotient([f(x + s * h) for s in (0, 1, -1, 0.5, -0.5)], h)

    value, error_bound = around(lambda x: x**3 - 2 * x, 0.7)
    assert value == pytest.approx(3 * 0.7**2 - 2, rel=1e-11)
    assert error_bound < 1e-4
    value, error_bound = around(lambda x: float(np.sign(x)), 0.0)  # of derivative 0 on each side
    assert abs(value) < error_bound
    value, error_bound = around(abs, 0.0)
    assert abs(value - 1.0) <= error_bound
    assert abs(value + 1.0) <= error_bound
