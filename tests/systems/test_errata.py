"""The errata: printed formulas are wrong, and the corrected ones agree with jaxlag."""

import re
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _families import mostly_full

from systems import errata
from systems.__main__ import main
from systems.errata import ERRATA, TEXT_ONLY, TOLERANCE, WRONG, confirmed
from systems.errata._erratum import DRAWS, around, examine

by_place = pytest.mark.parametrize(
    "erratum", mostly_full(ERRATA, *ERRATA[::10]), ids=lambda erratum: erratum.place
)


@by_place
def test_corrected_formula_agrees_with_jaxlag_and_the_printed_one_does_not(erratum):
    errors = examine(erratum)
    assert errors.right <= TOLERANCE
    assert errors.printed > WRONG
    assert np.isinf(errors.printed) == erratum.singular
    assert confirmed(errors)


@by_place
def test_states_differ_between_draws_and_not_between_calls(erratum):
    def numbers(state):
        return [state.t, *state.q, *state.v, *state.a, *state.params.values()]

    states = [numbers(state) for state in erratum.states()]
    assert len(states) == DRAWS
    for i, state in enumerate(states):
        assert np.all(np.isfinite(state))
        for other in states[:i]:
            assert sum(x != y for x, y in zip(state, other, strict=True)) > 1
    assert states == [numbers(state) for state in erratum.states()]


def test_no_place_is_listed_twice():
    places = [erratum.place for erratum in ERRATA] + [place for place, _ in TEXT_ONLY]
    assert len(set(places)) == len(places)


@pytest.mark.parametrize(
    "places",
    [[erratum.place for erratum in ERRATA], [place for place, _ in TEXT_ONLY]],
    ids=["evaluated", "text"],
)
def test_numbered_places_are_in_the_order_of_the_book(places):
    found = [re.match(r"(\d)\.(\d+)", place) for place in places]
    numbers = [tuple(map(int, match.groups())) for match in found if match]
    assert numbers == sorted(numbers)
    chapters = [re.findall(r"[1-4]", place)[0] for place in places]
    assert chapters == sorted(chapters)


@pytest.mark.full
def test_the_command_prints_one_line_for_each(capsys):
    assert main(["errata"]) == 0
    head, *lines = capsys.readouterr().out.splitlines()
    assert head.split() == ["place", "what", "is", "wrong", "printed", "right"]
    for erratum, line in zip(ERRATA, lines, strict=False):
        assert re.fullmatch(
            rf"{re.escape(erratum.place)} +{re.escape(erratum.wrong)} +(inf|\d\S+)  +\d\S+", line
        )
        assert len(line) == len(head)
    rest = lines[len(ERRATA) :]
    assert rest[0] == ""
    assert rest[2:-2] == [f"{place}: {remark}" for place, remark in TEXT_ONLY]
    assert rest[-1] == (f"evaluated {len(ERRATA)}: all confirmed; in words only {len(TEXT_ONLY)}")


@pytest.mark.parametrize("field", ["right", "printed"])
def test_unconfirmed_erratum_fails_the_command(field, monkeypatch, capsys):
    """A corrected formula that is as wrong as the printed one; a printed one that is right."""
    first, second, *_ = ERRATA
    other = {"right": second.printed, "printed": second.right}[field]
    monkeypatch.setattr(errata, "ERRATA", (first, replace(second, **{field: other})))
    assert main(["errata"]) == 1
    out = capsys.readouterr().out.splitlines()
    assert not out[1].endswith("FAIL")
    assert out[2].endswith("  FAIL")
    assert out[-1].startswith("evaluated 2: 1 not confirmed;")


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_right_formula_without_a_value_is_not_confirmed(value):
    errors = examine(replace(ERRATA[0], right=lambda s: value))
    assert not confirmed(errors)


def test_formula_of_another_shape_is_refused():
    with pytest.raises(
        ValueError, match=r"1\.15.* what the engine does, shape \(\), but it .*\(3,"
    ):
        examine(replace(ERRATA[0], right=lambda s: s.q))


def test_states_are_drawn_around_the_given_one():
    draw = around({"m": 2.0}, (1.0, -1.0), (0.5, 0.0), dq=(0.1, 0.0), dv=0.2, da=0.0)
    rng = np.random.default_rng(1)
    for _ in range(20):
        s = draw(rng)
        assert 1.4 <= s.params["m"] <= 2.8
        assert abs(s.q[0] - 1.0) <= 0.1
        assert s.q[1] == -1.0
        assert np.all(np.abs(s.v - [0.5, 0.0]) <= 0.2)
        assert np.all(s.a == 0)
        assert s.values("m") == (s.params["m"],)


def tricycle_as_printed(q, rates):
    """(v, v_Y, v_R, phi') of eqs. 4.72 to 4.74, wheelbase 1.2."""
    x, y, theta, phi = rates
    cT, sT, cF, sF = jnp.cos(q[2]), jnp.sin(q[2]), jnp.cos(q[3]), jnp.sin(q[3])
    return jnp.stack([(x * cT + y * sT) / cF, y * cT - x * sT, 1.2 * theta * cT * cF - x * sF, phi])


def tricycle_Theta(q):
    return jax.jacfwd(tricycle_as_printed, argnums=1)(q, jnp.zeros(4)).T


def test_rows_of_the_tricycle_need_no_approximation():
    """4.92: rows 1 and 4 of beta^T (Theta' - eta) on the constraints."""
    assert "4.92" in dict(TEXT_ONLY)
    rng = np.random.default_rng(2)
    for theta, phi, v, phi_rate in rng.uniform(-1.2, 1.2, (5, 4)):
        q = jnp.array([0.3, -0.2, theta, phi])
        speed, turn_rate = v * np.cos(phi), v * np.sin(phi) / 1.2
        rates = jnp.array([speed * np.cos(theta), speed * np.sin(theta), turn_rate, phi_rate])
        speeds = tricycle_as_printed(q, rates)
        np.testing.assert_allclose(speeds, [v, 0.0, 0.0, phi_rate], rtol=1e-14, atol=1e-15)
        Theta_rate = jax.jvp(tricycle_Theta, (q,), (rates,))[1]
        eta = jax.jacfwd(tricycle_as_printed)(q, rates).T
        found = np.linalg.solve(tricycle_Theta(q), Theta_rate - eta)[[0, 3]]
        slope, cT = np.tan(phi), np.cos(theta)
        exact = [[phi_rate * slope, 0, -phi_rate * cT, 0], [-v * slope, 0, v * cT, 0]]
        np.testing.assert_allclose(found, exact, rtol=1e-13, atol=1e-14)


def test_matrix_of_the_tricycle_is_singular_across_the_x_axis():
    """4.74: its determinant is that of theta' in v_R, l cos(theta)."""
    assert "4.74" in dict(TEXT_ONLY)
    for theta in (0.0, 0.7, 0.5 * np.pi, -0.5 * np.pi):
        det = np.linalg.det(tricycle_Theta(jnp.array([0.3, -0.2, theta, 0.4])))
        np.testing.assert_allclose(abs(det), 1.2 * np.cos(theta), atol=1e-15)
