"""Null directions in terms of params, from factors with a known null space."""

import numpy as np

from jaxlag._fit._covariance import Spectrum, combination, saturated


def spectrum(names, values, *known):
    """Of measurements of products of powers, each with an accuracy of 1e-3."""
    values = np.asarray(values, float)
    measurements = 1e3 * np.asarray(known, float) / values
    factor = np.zeros((len(values), len(values)))
    factor[: len(measurements)] = measurements
    return Spectrum(names, values, np.linalg.qr(factor)[1])


def test_ratio_is_determined_if_only_it_is_measured():
    found = spectrum(("g", "l", "c"), (9.81, 0.5, 0.1), (1, -1, 0), (0, 0, 1))
    assert found.determined == ("l/g",)
    assert found.unidentifiable == (
        "change together without effect on the channels: g by +1 %, l by +1 %",
    )
    covariance = found.covariance()
    assert np.isinf(np.diag(covariance)[:2]).all()
    np.testing.assert_allclose(covariance[2, 2], (0.1 / 1e3) ** 2)


def test_unmeasured_parameter_is_not_determined():
    found = spectrum(("a", "b"), (2.0, 3.0), (1, 0))
    assert found.unidentifiable == ("b is not determined at all",)
    assert found.determined == ()


def test_all_measured_parameters_are_determined():
    found = spectrum(("a", "b"), (2.0, 3.0), (1, 0), (1, 1))
    assert found.unidentifiable == found.determined == ()
    assert np.isfinite(found.covariance()).all()


def test_combinations_are_written_as_powers():
    names = ("m", "l", "g")
    assert combination(names, np.array([1.0, 2.0, -1.0])) == "m l^2/g"
    assert combination(names, np.array([-1.0, 0.0, -0.5])) == "m g^(1/2)"
    assert combination(names, np.array([1.0, -0.123, 0.0])) == "1 dm/m -0.123 dl/l"


def test_parameters_with_saturated_variables_are_on_a_bound():
    """b no longer moves; c moves little, but its effect was measured."""
    by_z, factor = np.diag([1.0, 1e-9, 1e-5]), np.diag([50.0, 1e-6, 3.0])
    assert saturated(factor, by_z, np.eye(3)).tolist() == [False, True, False]


def test_parameter_without_effect_is_not_on_a_bound():
    assert saturated(np.diag([50.0, 0.0]), np.eye(2), np.eye(2)).tolist() == [False, False]


def test_matrix_is_on_a_bound_if_one_of_its_variables_is():
    """C C^T with C = ((e^u0, 0), (u2, e^u1)) at u0 = -30: its entries (0, 0), (1, 0), (1, 1).

    A fourth parameter belongs to another leaf.
    """
    a, b, c = np.exp(-30.0), 1.0, 0.5
    by_z = np.zeros((4, 4))
    by_z[:3, :3] = [[2 * a * a, 0.0, 0.0], [a * c, 0.0, a], [0.0, 2 * b * b, 2 * c]]
    at_first = np.zeros((4, 4))
    at_first[:3, :3] = [[2.0, 0.0, 0.0], [c, 0.0, 1.0], [0.0, 2.0, 2 * c]]
    by_z[3, 3] = at_first[3, 3] = 1.0
    factor = 100.0 * by_z
    assert saturated(factor, by_z, at_first).tolist() == [True, True, True, False]
