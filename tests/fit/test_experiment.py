"""Recordings: windows and parts of them; every error by name."""

import numpy as np
import pytest
from _measured import TS, angles, experiment, fit, within

import jaxlag as jl
from tests._user import unchecked  # noqa: F401


@pytest.mark.full
def test_windows_and_parts_divide_a_recording():
    pieces = experiment().windows(1.0)
    assert [len(piece.ts) for piece in pieces] == [50, 50, 50]
    assert pieces[1].ts[0] == TS[50]
    np.testing.assert_array_equal(pieces[2].channels["x"][:, 0], angles()[100:150])
    found = fit(pieces)
    within(found, ("l",))
    assert len(found.starts) == 3
    gap = jl.Experiment(np.concatenate([TS, TS + 10.0]), {"x": np.tile(angles(), 2)})
    assert [piece.ts[0] for piece in gap.windows(1.5)] == [0.0, 1.5, 10.0, 10.5]


@pytest.mark.parametrize(
    ("seconds", "message"),
    [
        (0, r"`seconds` must be a positive number, but it was 0"),
        (np.nan, r"`seconds` must be a positive number, but it was nan"),
        (-1, r"`seconds` must be a positive number, but it was -1"),
        (4.0, r"at most the 3\.02 s of experiment, but it was 4"),
        (0.03, r"`seconds` must cover two samples or more, but it was 0\.03"),
    ],
)
def test_invalid_windows_are_named(seconds, message):
    with pytest.raises(ValueError, match=message):
        experiment().windows(seconds)


NAN = np.full(len(TS), np.nan)


@pytest.mark.parametrize(
    ("ts", "channels", "options", "message"),
    [
        (TS[::-1], {"x": TS}, {}, r"`ts` must increase strictly, but ts\[0\] = 3 and"),
        (TS[:1], {"x": TS[:1]}, {}, r"an array of two times or more"),
        (TS, {"x": TS[:-1]}, {}, r"`channels\['x'\]` must have one sample per time, 151"),
        (TS, {"x": NAN}, {}, r"`channels\['x'\]` must hold some numbers, but all were NaN"),
        (TS, {}, {}, r"one channel or more"),
        (TS, {"x": np.where(TS > 1, np.inf, TS)}, {}, r"finite, or NaN where nothing was measured"),
        (TS, {"x": TS}, {"sigma": {"x": 0.0}}, r"`sigma\['x'\]` must be positive"),
        (TS, {"x": TS}, {"sigma": {"x": np.inf}}, r"positive and finite, .* write NaN into the"),
        (
            TS,
            {"x": TS},
            {"sigma": {"x": np.ones(3)}},
            r"a number, 151 numbers, or an array of shape \(151, 1",
        ),
        (TS, {"x": TS}, {"sigma": [0.1]}, r"be one number for all channels, or a dict by their"),
        (TS, {"x": TS}, {"sigma": -0.1}, r"`sigma\['x'\]` must be positive"),
        (TS, {"x": TS}, {"sigma": {"y": 1.0}}, r"name channels among \['x'\], but one was 'y'"),
        (TS, {"x": TS}, {"q0": np.ones((3, 1))}, r"`q0` must be \(n,\) numbers at ts\[0\]"),
        (TS, {"x": TS}, {"start_sigma": 0.0}, r"be given together with q0 and v0"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_invalid_experiment_is_named(ts, channels, options, message):
    with pytest.raises(ValueError, match=message):
        jl.Experiment(ts, channels, **options)


def test_one_sigma_is_that_of_all_channels():
    one = jl.Experiment(TS, {"x": TS, "y": np.stack([TS, TS], 1)}, sigma=np.array(0.1))
    each = jl.Experiment(TS, {"x": TS, "y": np.stack([TS, TS], 1)}, sigma={"x": 0.1, "y": 0.1})
    assert one.sigma.keys() == {"x", "y"}
    for name, x in each.sigma.items():
        np.testing.assert_array_equal(one.sigma[name], x)
