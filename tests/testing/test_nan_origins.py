"""The origin of a derivative that is not finite: the operation and the line."""

import jax
import jax.numpy as jnp
import pytest
from _checked import (
    PARAMS,
    Q,
    V,
    check,
    checked,
    file_of,
    here,
    length,
    line_of,
    places,
    scan_body,
    scanned,
)
from _families import mostly_full
from jax import lax

import jaxlag as jl
from jaxlag import testing
from jaxlag._system._nan_origins import TracedProgram
from jaxlag.testing import _check_derivatives
from tests._user import unchecked  # noqa: F401


def length_by_norm(q, params):
    stretched = jnp.linalg.norm(q + 3.0)
    return stretched * jnp.linalg.norm(q)  # wrong


def angle(q, params):
    turned = jnp.arctan2(q[0], 2.0 + q[1])
    return turned + jnp.arctan2(q[1], q[0]) ** 2  # wrong


def quotient(q, params):
    x = q[0]
    return jnp.sin(x) / x + q[1] / 2.0  # wrong


def unsafe_where(q, params):
    x = q[0] ** 2
    root = jnp.sqrt(x)  # wrong
    return jnp.where(x > 0, root, 0.0)


def second_order(q, params):
    return jnp.abs(q[0]) ** 1.5 + q[1] ** 3.5  # wrong


def third_order(q, params):
    even = q[1] ** 4.5
    return even + q[0] ** 2.5  # wrong


@jax.jit
def helper(x):
    y = x + 1.0
    return y * jnp.sqrt(x)  # wrong


def jitted(q, params):
    return helper(q[0] + 2.0) * helper(q[1] ** 2)


def hidden(q, params):
    inverse = lax.stop_gradient(1.0 / q[0])
    offset = 0.0 * jnp.where(q[0] == 0, 0.0, inverse)
    return offset * q[1] + jnp.sqrt(q @ q)  # wrong


NOT_FINITE = {
    length: ("sqrt", 1, "forward"),
    length_by_norm: ("sqrt", 1, "forward"),
    angle: ("atan2", 1, "forward"),
    quotient: ("div", 0, "value"),
    unsafe_where: ("sqrt", 1, "reverse"),
    second_order: ("pow", 2, "forward"),
    third_order: ("pow", 3, "forward"),
    hidden: ("sqrt", 1, "forward"),
}


@pytest.mark.parametrize(
    "potential", mostly_full(NOT_FINITE, *list(NOT_FINITE)[::2]), ids=lambda f: f.__name__
)
def test_origin_of_a_derivative_that_is_not_finite_is_named(potential):
    """Only at zero; the operation and its line, not another of the same kind."""
    primitive, order, mode = NOT_FINITE[potential]
    report = checked(potential)
    assert not report.ok
    assert places(report) == here(primitive, potential, "# wrong")
    for finding in report.findings:
        assert (finding.function, finding.kind) == ("lagrangian", "not finite")
        assert (finding.state, finding.q, finding.v) == ("zero", (0.0, 0.0), (0.0, 0.0))
        assert (finding.order, finding.mode, finding.vmapped) == (order, mode, False)
        assert finding.variables == ("q" if order else "")
        assert f"{primitive} at {file_of(potential)}:{finding.line}" in str(finding)
        assert finding.where in str(report)


@pytest.mark.parametrize(("potential", "inner"), [(jitted, helper), (scanned, scan_body)])
def test_origins_inside_jitted_helpers_and_loops_are_named(potential, inner):
    """On the line inside; `scanned` also at "one", where its second entry is 0."""
    report = checked(potential)
    assert places(report) == here("sqrt", inner, "# wrong")
    assert {f.order for f in report.findings} == {1}
    assert [f.state for f in report.findings] == ["zero", "one"]


def test_origins_inside_choices_under_vmap_are_named():
    """Both branches are computed there, in separate programs."""

    def chosen(q):
        return lax.cond(q > -1.0, lambda x: jnp.cos(x) + jnp.sqrt(x), lambda x: x / 2.0, q)  # wrong

    program = TracedProgram(chosen, jnp.zeros(()))
    batch = jnp.zeros(3)
    for derivative in (jax.vmap(jax.grad(program)), jax.grad(lambda q: jax.vmap(program)(q).sum())):
        found = program.origins(jax.make_jaxpr(derivative)(batch), batch)
        assert found == [("sqrt", __file__, line_of(chosen, "# wrong"))]


def choosing(q):
    """log(0) is selected, 1/0 is not."""
    taken = jnp.log(q)  # wrong
    return jnp.where(jnp.array([True, False]), taken, 1.0 / q)


def entry_by_entry(q):
    """1/0 in the selected entry, log(0) in the other one."""
    entries = jnp.log(q) + 1.0
    entries = entries + 1.0 / (q - 1.0)  # wrong
    return jnp.where(jnp.array([False, True]), entries, 0.0)


def before_a_loop(q):
    start = jnp.log(q[0])  # wrong
    return lax.scan(lambda total, x: (total + jnp.cos(x), x), start, q)[0]


def entries_of_a_loop(q):
    entries = jnp.log(q)  # wrong
    return lax.scan(lambda total, x: (jnp.cos(total), total + x), 1.0, entries, reverse=True)[1]


def shared_by_iterations(q):
    shared = jnp.log(q[0])  # wrong
    return lax.fori_loop(0, 3, lambda k, x: x + shared, q[1])


def before_an_open_loop(q):
    start = jnp.log(q[0])  # wrong
    result = lax.while_loop(lambda c: c[0] < 3, lambda c: (c[0] + 1, c[1] * 2.0), (0, start))
    return result[1] + q[1] / 3.0


@pytest.mark.parametrize(
    ("function", "primitive"),
    [
        (choosing, "log"),
        (entry_by_entry, "div"),
        (before_a_loop, "log"),
        (entries_of_a_loop, "log"),
        (shared_by_iterations, "log"),
        (before_an_open_loop, "log"),
    ],
    ids=lambda f: getattr(f, "__name__", f),
)
def test_origins_are_followed_through_choices_and_loops(function, primitive):
    """Back to the one operation from which the result inherits it."""
    q = jnp.array([0.0, 1.0])
    program = TracedProgram(function, q)
    found = program.origins(program.closed, q)
    assert found == [(primitive, __file__, line_of(function, "# wrong"))]


def test_the_line_that_calls_the_check_is_not_named():
    program = TracedProgram(lax.log, jnp.zeros(()))
    assert program.origins(program.closed, jnp.zeros(())) == [("log", "", 0)]


def test_every_origin_is_named():
    """Those of one state in program order."""
    report = check(lambda q, params: length(q, params) + angle(q, params))
    assert places(report) == here("sqrt", length, "# wrong") | here("atan2", angle, "# wrong")
    assert [f.primitive for f in report.findings] == ["sqrt", "atan2"]


@pytest.mark.full
def test_hints_name_the_function_to_use():
    hints = {f.__name__: checked(f).findings[0].hint for f in NOT_FINITE}
    assert "jaxlag.math.norm" in hints["length"]
    assert "jaxlag.math.atan2" in hints["angle"]
    assert "jaxlag.math.sinc" in hints["quotient"]
    assert "where(ok, f(where(ok, x, 1.0)), ...)" in hints["unsafe_where"]
    names = " ".join(_check_derivatives.HINTS.values()).replace(",", " ").split()
    named = [x.removeprefix("jaxlag.math.").strip(".;") for x in names if "jaxlag.math" in x]
    assert len(named) >= 8
    assert all(hasattr(jl.math, name) for name in named)


@pytest.mark.full
def test_following_the_hints_removes_the_findings():
    def corrected(q, params):
        x = q[0] ** 2
        safe = jnp.where(x > 0, jnp.sqrt(jnp.where(x > 0, x, 1.0)), 0.0)
        turned = jl.math.atan2(q[1], q[0])
        return jl.math.norm(q) + turned + jl.math.sinc(q[0]) + safe + jl.math.sqrt(x)

    assert check(corrected).ok


def test_masked_infinities_are_not_findings():
    """Infinite, but masked in every derivative: of `hidden` only the root is named."""

    def masked(q, params):
        inverse = lax.stop_gradient(1.0 / q[0])
        return 0.0 * jnp.where(q[0] == 0, 0.0, inverse) * q[1]

    assert check(masked).ok


def test_choices_by_cond_stay_safe_under_vmap():
    """JAX passes an argument without derivatives to the branch that is not taken."""

    def chosen(q, params):
        return lax.cond(q[0] != 0, lambda x: jnp.sin(x) / x, lambda x: 1.0 + 0.0 * x, q[0])

    assert check(chosen).ok


def test_findings_only_under_vmap_are_named():
    @jax.custom_batching.custom_vmap
    def ratio(x):
        return lax.cond(x > 0, lambda x: jnp.sin(x) / x, lambda x: 1.0 + 0.0 * x, x)

    @ratio.def_vmap
    def rule(size, batched, x):
        return jnp.sin(x) / x, True  # wrong

    def pull(t, q, v, params):
        return jnp.stack([ratio(q[0]), -q[1]])

    system = jl.System(
        lambda t, q, v, params: v @ v, ("x", "y"), forces=[jl.GeneralizedForce(pull, "pull")]
    )
    report = testing.check_derivatives(system, Q, V, {})
    (finding,) = report.findings
    assert (finding.function, finding.order, finding.state) == ("force 'pull': Q", 0, "zero")
    assert finding.vmapped
    assert "vmap" in finding.hint
    assert "under vmap" in str(finding)
    assert list(report.omitted) == ["force 'pull': Q"]
    assert "no reverse derivatives" in str(report)


def test_variables_of_a_finding_are_named():
    def lagrangian(t, q, v, params):
        return v @ v + jnp.sqrt(params["c"]) + jnp.sqrt(t) + jnp.sqrt(q[0] + v[1] ** 2)

    system = jl.System(lagrangian, ("x", "y"))
    report = testing.check_derivatives(system, Q, V, PARAMS)
    found = {(f.line, f.variables) for f in report.findings if f.state == "zero"}
    line = line_of(lagrangian, "jnp.sqrt(t)")
    assert found == {(line, "t or q or v or params")}
    assert {f.variables for f in report.findings if f.state == "given"} == {"t or params"}
    # The derivative by v alone is 0 times infinity.
    later = testing.check_derivatives(system, Q, V, {**PARAMS, "c": 2.0}, t=1.0)
    assert {(f.state, f.variables) for f in later.findings} == {("zero", "q or v")}


def test_integer_params_are_not_differentiated():
    report = check(lambda q, params: q[0] ** params["n"], {"k": 1.0, "n": 3})
    assert report.ok


def test_origins_inside_loops_without_a_fixed_number_of_iterations():
    """Created in the fourth iteration, as the third gives 0: 1.0625^2, 0.75^2, 0.5^2, 0."""

    def shrink(carry):
        k, x = carry
        return k + 1, jnp.sqrt(x) - 0.5  # wrong

    def pull(t, q, v, params):
        return lax.while_loop(lambda carry: carry[0] < 4, shrink, (0, q + 1.0625**2))[1]

    force = jl.GeneralizedForce(pull, "pull")
    system = jl.System(lambda t, q, v, params: v @ v, ("x", "y"), forces=(force,))
    report = testing.check_derivatives(system, Q, V, {})
    assert places(report) == here("sqrt", shrink, "# wrong")
    assert [(f.state, f.order) for f in report.findings] == [("zero", 1), ("one", 1)]
