"""Null directions in the params' names, from factors whose null space is known."""

import numpy as np

from jaxlag._identifiability import Spectrum, combination


def spectrum(names, values, *known):
    """Of measurements of products of powers, each 1e3 times as precise as 1."""
    values = np.asarray(values, float)
    rows = 1e3 * np.asarray(known, float) / values
    factor = np.zeros((len(values), len(values)))
    factor[: len(rows)] = rows
    return Spectrum(names, values, np.linalg.qr(factor)[1])


def test_only_a_ratio_is_known():
    found = spectrum(("g", "l", "c"), (9.81, 0.5, 0.1), (1, -1, 0), (0, 0, 1))
    assert found.determined == ("l/g",)
    assert found.unidentifiable == ("change together without a trace: g by +1 %, l by +1 %",)
    covariance = found.covariance()
    assert np.isinf(np.diag(covariance)[:2]).all()
    np.testing.assert_allclose(covariance[2, 2], (0.1 / 1e3) ** 2)


def test_a_number_of_which_nothing_is_known():
    found = spectrum(("a", "b"), (2.0, 3.0), (1, 0))
    assert found.unidentifiable == ("b is not determined at all",)
    assert found.determined == ()


def test_everything_is_known():
    found = spectrum(("a", "b"), (2.0, 3.0), (1, 0), (1, 1))
    assert found.unidentifiable == found.determined == ()
    assert np.isfinite(found.covariance()).all()


def test_combinations_in_words():
    names = ("m", "l", "g")
    assert combination(names, np.array([1.0, 2.0, -1.0])) == "m l^2/g"
    assert combination(names, np.array([-1.0, 0.0, -0.5])) == "m g^(1/2)"
    assert combination(names, np.array([1.0, -0.123, 0.0])) == "1 dm/m -0.123 dl/l"
