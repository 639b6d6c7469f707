"""Experiment: measured channels, their times and noise, and the inputs."""

from collections.abc import Callable, Mapping
from itertools import pairwise
from typing import Any, final

import equinox as eqx
import numpy as np

from jaxlag._core._arrays import concrete
from jaxlag._core._errors import invalid, unsupported
from jaxlag._model._inputs import check_inputs, check_range
from jaxlag._tracing._signature import require_arity
from jaxlag._tracing._traced_function import TracedFunction, traced_function


@final
class Experiment(eqx.Module):
    """One recording: channels measured at times, from an unknown, known or approximate start.

    Args:
        ts: (s,) times, s, strictly increasing, s >= 2. Spacing may vary.
        channels: name -> measured values, (s,) or (s, k), in the unit of the quantity; NaN
            for missing values. A name is that of a coordinate ("theta"), of a velocity
            ("theta'"), an acceleration ("theta''"), a quasi-velocity, a constraint row (its
            multiplier), or one of the `channels` given to `jl.fit`.
        inputs: as for `jl.simulate`; tables must reach from ts[0] to ts[-1]. Experiments that are
            fitted together have the same input names. Under each name there are tables of one kind
            in all experiments, of any length, or any functions and constants; different ones are
            all computed. `inputs` may also be a function of the params to such a dict, if times or
            values of tables, or knots, depend on them: a delay, the time of a switch.
        sigma: standard deviation of the noise, in the channels' units: name -> number, (s,) or
            (s, k); or one number for all channels. For channels without, it is estimated from the
            residuals.
        q0: coordinates at ts[0], (n,), or at all of ts, (s, n), m or rad: the initial guess.
            Without it the coordinates must be among the channels.
        v0: velocities, (n,) or (s, n); for systems with quasi-velocities these, one for each
            name, m/s or rad/s. By default they are slopes of the measured coordinates.
        start_sigma: uncertainty of q0 and v0: None, the state at ts[0] is free; 0, it is exact;
            standard deviations, m, rad, m/s, rad/s: a number, or one for each of the
            coordinates and of the free velocities.
        name: its name in messages.

    Raises:
        ValueError: times that do not increase, shapes that do not fit, a channel without any
            number, a sigma that is not positive, a `start_sigma` without q0 and v0.

    Example:
        A push that ends at an unknown time:

        >>> import jaxlag as jl, numpy as np
        >>> def inputs(params):
        ...     return {"push": jl.ZeroOrderHold([0.0, params["end"], 3.0], [1.0, 0.0, 0.0])}
        >>> ts = np.linspace(0.0, 3.0, 31)
        >>> data = jl.Experiment(ts, {"x": np.sin(ts)}, inputs=inputs)
        >>> data.inputs_at({"end": 0.5})["push"].times.tolist()
        [0.0, 0.5, 3.0]
    """

    ts: np.ndarray
    channels: dict[str, np.ndarray]
    inputs: Any  # by name, or a function of the params to these
    sigma: dict[str, np.ndarray]
    q0: np.ndarray | None
    v0: np.ndarray | None
    start_sigma: np.ndarray | None
    name: str

    def __init__(
        self,
        ts: Any,
        channels: Mapping[str, Any],
        *,
        inputs: Mapping[str, Any] | Callable[[Any], Mapping[str, Any]] | None = None,
        sigma: Any = None,
        q0: Any = None,
        v0: Any = None,
        start_sigma: Any = None,
        name: str = "experiment",
    ) -> None:
        if not concrete(ts, channels, sigma, q0, v0, start_sigma):
            why = "its measurements are numbers"
            raise unsupported("An Experiment inside jit, vmap and grad", why, "Make it outside.")
        self.name = name
        self.ts = _times(name, ts)
        count = len(self.ts)
        if not isinstance(channels, Mapping) or not channels:
            raise invalid(
                f"{name}: channels", "be a dict with one channel or more", f"it was {channels}"
            )
        self.channels = {key: _channel(name, key, x, count) for key, x in channels.items()}
        if callable(inputs):
            require_arity(f"{name}: inputs", inputs, ("params",))
            self.inputs = traced_function(inputs)
        else:
            self.inputs = check_inputs(inputs)
            check_range(self.inputs, self.ts, f"ts of {name}")
        self.sigma = {}
        for key, x in _by_channel(name, sigma, self.channels).items():
            if key not in self.channels:
                known = sorted(self.channels)
                raise invalid(f"{name}: sigma", f"name channels among {known}", f"one was {key!r}")
            x, shape = np.asarray(x, float), self.channels[key].shape
            given = x.shape
            try:
                x = np.broadcast_to(x[:, None] if x.ndim == 1 else x, shape)
            except ValueError:
                must = f"be a number, {shape[0]} numbers, or an array of shape {shape}"
                raise invalid(f"{name}: sigma[{key!r}]", must, f"its shape was {given}") from None
            if not np.all((x > 0) & (x < np.inf)):
                fix = "To exclude a sample, write NaN into the channel instead."
                was = f"its least was {np.min(x):g}, its largest {np.max(x):g}"
                raise invalid(f"{name}: sigma[{key!r}]", "be positive and finite", was, fix)
            self.sigma[key] = x
        self.q0, self.v0 = _guess(name, "q0", q0, count), _guess(name, "v0", v0, count)
        self.start_sigma = None if start_sigma is None else np.asarray(start_sigma, float)
        if self.start_sigma is not None:
            if self.q0 is None or self.v0 is None:
                was = "they were not both given"
                raise invalid(f"{name}: start_sigma", "be given together with q0 and v0", was)
            if not np.all(self.start_sigma >= 0):
                was = f"it was {start_sigma}"
                raise invalid(f"{name}: start_sigma", "be zero or positive, or None", was)

    def inputs_at(self, params: Any) -> dict[str, Any]:
        """The inputs by name, for these params.

        Raises:
            ValueError: invalid inputs, or tables that do not reach from ts[0] to ts[-1].
        """
        if not isinstance(self.inputs, TracedFunction):
            return self.inputs
        found = check_inputs(self.inputs.function(params))
        check_range(found, self.ts, f"ts of {self.name}")
        return found

    def part(self, samples: slice | np.ndarray, name: str | None = None) -> "Experiment":
        """Some of its samples as an experiment; its start is free unless it is the same start."""
        indices = np.arange(len(self.ts))[samples]

        def of(x: np.ndarray | None) -> np.ndarray | None:
            if x is None or (x.ndim == 1 and indices[0] > 0):
                return None
            return x if x.ndim == 1 else x[indices]

        return Experiment(
            self.ts[indices],
            {key: x[indices] for key, x in self.channels.items()},
            inputs=self.inputs,
            sigma={key: x[indices] for key, x in self.sigma.items()},
            q0=of(self.q0),
            v0=of(self.v0),
            start_sigma=self.start_sigma if indices[0] == 0 else None,
            name=self.name if name is None else name,
        )

    def windows(self, seconds: float | int) -> tuple["Experiment", ...]:
        """Consecutive pieces of equal length, each with its own start.

        A shorter remainder is left out, and so are pieces with less than two samples, as in gaps.

        Raises:
            ValueError: the recording is shorter than that, or a piece would have one sample.
        """
        if not 0 < seconds < np.inf:
            raise invalid("seconds", "be a positive number", f"it was {seconds!r}")
        per_sample = np.median(np.diff(self.ts))
        count = int(np.floor((self.ts[-1] - self.ts[0] + per_sample) / seconds * (1 + 1e-9)))
        if count < 1:
            length = self.ts[-1] - self.ts[0]
            must = f"be at most the {length + per_sample:g} s of {self.name}"
            raise invalid("seconds", must, f"it was {seconds:g}")
        edges = self.ts[0] + seconds * np.arange(count + 1) - 0.5 * per_sample
        samples = np.searchsorted(self.ts, edges)
        if seconds < 2 * per_sample:
            raise invalid("seconds", "cover two samples or more", f"it was {seconds:g}")
        return tuple(
            self.part(slice(a, b), f"{self.name}[{self.ts[a]:g} s]")
            for a, b in pairwise(samples)
            if b - a >= 2  # fewer where the recording has a gap
        )


def _times(name: str, ts: Any) -> np.ndarray:
    ts = np.asarray(ts, float)
    if ts.ndim != 1 or len(ts) < 2:
        raise invalid(
            f"{name}: ts", "be an array of two times or more", f"its shape was {ts.shape}"
        )
    if not np.all(np.isfinite(ts)):
        raise invalid(f"{name}: ts", "be finite", "some were nan or inf")
    if not np.all(np.diff(ts) > 0):
        i = int(np.argmin(np.diff(ts) > 0))
        was = f"ts[{i}] = {ts[i]:g} and ts[{i + 1}] = {ts[i + 1]:g}"
        raise invalid(
            f"{name}: ts", "increase strictly", was, "Sort the samples, drop repeated ones."
        )
    return ts


def _by_channel(name: str, sigma: Any, channels: Mapping[str, Any]) -> Mapping[str, Any]:
    """Sigma by the name of the channel."""
    if sigma is None or isinstance(sigma, Mapping):
        return sigma or {}
    if np.ndim(sigma) or not np.issubdtype(np.asarray(sigma).dtype, np.number):
        must = "be one number for all channels, or a dict by their names"
        fix = f"Write sigma={{{next(iter(channels))!r}: ...}}."
        raise invalid(f"{name}: sigma", must, f"it was {sigma!r}", fix)
    return dict.fromkeys(channels, sigma)


def _channel(name: str, key: str, x: Any, count: int) -> np.ndarray:
    x = np.asarray(x, float)
    if x.ndim not in (1, 2) or x.shape[0] != count:
        must = f"have one sample per time, {count}"
        raise invalid(f"{name}: channels[{key!r}]", must, f"its shape was {x.shape}")
    if not np.any(np.isfinite(x)):
        fix = "Leave the channel out."
        raise invalid(f"{name}: channels[{key!r}]", "hold some numbers", "all were NaN", fix)
    if np.any(np.isinf(x)):
        must = "be finite, or NaN where nothing was measured"
        raise invalid(f"{name}: channels[{key!r}]", must, "some were inf")
    return x[:, None] if x.ndim == 1 else x


def _guess(name: str, which: str, x: Any, count: int) -> np.ndarray | None:
    if x is None:
        return None
    x = np.asarray(x, float)
    if x.ndim not in (1, 2) or (x.ndim == 2 and x.shape[0] != count):
        must = f"be (n,) numbers at ts[0] or ({count}, n) along ts"
        raise invalid(f"{name}: {which}", must, f"its shape was {x.shape}")
    return x
