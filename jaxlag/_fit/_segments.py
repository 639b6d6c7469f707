"""Segments of equal shape, cut from experiments, as lanes of one batch."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxlag._core._errors import invalid
from jaxlag._fit._experiment import Experiment
from jaxlag._fit._stacked_inputs import AbstractStackedInputs, computed, stacked
from jaxlag._model._input_signals import LinearInterpolation, ZeroOrderHold
from jaxlag._system._system import System


class Segments(NamedTuple):
    """k segments of s samples each.

    The last sample is the end of a segment: its last measurement, or the start of the next one.
    Segments with fewer samples are filled up with times before it, of weight 0.

    Attributes:
        ts: (k, s), s.
        values: (k, s, m), the measurements; 0 for missing ones.
        weights: (k, s, m), 1/sigma; 0 for missing measurements.
        follows: (k,), whether the next segment continues this one.
        inputs: of each segment, stacked.
        guess: (k, d), the state (q, v) or (q, u) at each start, approximately.
        held: (k, d), standard deviations of that guess; 0 if it is exact, inf if unknown.
    """

    ts: Float[Array, "k s"]
    values: Float[Array, "k s m"]
    weights: Float[Array, "k s m"]
    follows: Bool[Array, " k"]
    inputs: AbstractStackedInputs
    guess: Float[Array, "k d"]
    held: Float[Array, "k d"]


class SegmentLayout(NamedTuple):
    """The positions of the samples of experiments in the segments.

    Attributes:
        owner: (k,), the experiment of each segment.
        first: (k,), its first sample.
        count: (k,), its number of samples.
        follows: (k,), whether the next segment continues this one.
        places: positions of the samples of each segment among its s.
        columns: name -> the channel's columns among m.
    """

    owner: Int[np.ndarray, " k"]
    first: Int[np.ndarray, " k"]
    count: Int[np.ndarray, " k"]
    follows: Bool[np.ndarray, " k"]
    places: tuple[np.ndarray, ...]
    columns: dict[str, slice]


def layout(experiments: Sequence[Experiment], segments: int) -> SegmentLayout:
    """`segments` per experiment, of equally many samples if possible."""
    owner, first, count = [], [], []
    for i, experiment in enumerate(experiments):
        samples = len(experiment.ts)
        if segments > samples // 2:
            was = f"it was {segments}, and {experiment.name} has {samples} samples"
            raise invalid("segments", "leave two samples or more in each segment", was)
        edges = np.round(np.linspace(0, samples, segments + 1)).astype(int)
        owner += [i] * segments
        first += edges[:-1].tolist()
        count += np.diff(edges).tolist()
    widths: dict[str, int] = {}
    for experiment in experiments:
        for name, x in experiment.channels.items():
            if widths.setdefault(name, x.shape[1]) != x.shape[1]:
                must = f"have {widths[name]} columns in every experiment"
                was = f"it had {x.shape[1]} in {experiment.name}"
                raise invalid(f"channels[{name!r}]", must, was)
    edges = np.cumsum([0, *widths.values()])
    columns = {name: slice(a, b) for name, a, b in zip(widths, edges[:-1], edges[1:], strict=True)}
    follows = np.array([a == b for a, b in pairwise([*owner, -1])])
    last = max(n + further for n, further in zip(count, follows, strict=True)) - 1
    places = tuple(
        np.arange(n) if further else np.append(np.arange(n - 1), last)
        for n, further in zip(count, follows, strict=True)
    )
    return SegmentLayout(
        np.array(owner), np.array(first), np.array(count), follows, places, columns
    )


def pack(
    system: System,
    experiments: Sequence[Experiment],
    where: SegmentLayout,
    sigma: dict[str, float],
    guess: np.ndarray,
) -> Segments:
    """The segments of `where`.

    Args:
        system: the mechanical system.
        experiments: the measurements.
        where: samples of each segment.
        sigma: of channels without sigma in their experiment.
        guess: states at the starts of the segments, (k, d).
    """
    length = int(np.max(where.count + where.follows))
    width = max(part.stop for part in where.columns.values())
    size = len(where.owner)
    ts = np.zeros((size, length))
    values, weights = np.zeros((size, length, width)), np.zeros((size, length, width))
    held = np.full(guess.shape, np.inf)
    inputs = []
    for k, (i, a, n) in enumerate(zip(where.owner, where.first, where.count, strict=True)):
        experiment, b, place = experiments[i], a + n, where.places[k]
        times = experiment.ts[a : b + int(where.follows[k])]
        ts[k, : len(times) - 1] = times[:-1]
        ts[k, len(times) - 2 :] = np.linspace(times[-2], times[-1], length - len(times) + 2)
        for name, x in experiment.channels.items():
            part, samples = where.columns[name], x[a:b]
            known = np.isfinite(samples)
            values[k, place, part] = np.where(known, samples, 0.0)
            noise = experiment.sigma[name][a:b] if name in experiment.sigma else sigma[name]
            weights[k, place, part] = known / noise
        if a == 0 and experiment.start_sigma is not None:
            held[k] = experiment.start_sigma
        inputs.append(_inputs_between(experiment.inputs, ts[k, 0], ts[k, -1]))
    ends = ts[:, -1].tolist()
    return Segments(
        jnp.asarray(ts),
        jnp.asarray(values),
        jnp.asarray(weights),
        jnp.asarray(where.follows),
        computed(inputs, ends) if any(map(callable, inputs)) else stacked(inputs, ends),
        jnp.asarray(guess),
        jnp.asarray(held),
    )


def _inputs_between(inputs: Any, start: float, end: float) -> Any:
    """The inputs with only those samples of their tables that are read from start to end.

    Inputs that are a function of params are unchanged.
    """
    if callable(inputs):
        return inputs

    def cut(signal: Any) -> Any:
        if not isinstance(signal, LinearInterpolation | ZeroOrderHold):
            return signal
        times = np.asarray(signal.times)
        a = int(np.clip(np.searchsorted(times, start, side="right") - 1, 0, len(times) - 2))
        b = int(np.clip(np.searchsorted(times, end, side="left") + 1, a + 2, len(times)))
        return type(signal)(times[a:b], np.asarray(signal.values)[a:b])

    return {name: cut(signal) for name, signal in inputs.items()}
