"""Residuals of experiments: their channels, and the root mean square of one."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from jaxlag._core._errors import bad


def channels_of(residuals: Sequence[Mapping[str, np.ndarray]]) -> tuple[str, ...]:
    """Names of all channels."""
    return tuple(dict.fromkeys(name for each in residuals for name in each))


def rms_of(residuals: Sequence[Mapping[str, np.ndarray]], channel: str) -> Float[np.ndarray, " k"]:
    """Root mean square of a channel over all rows that have a number; NaN where none has.

    Raises:
        ValueError: a channel that nobody measured.
    """
    known = channels_of(residuals)
    if channel not in known:
        raise bad("channel", f"be one of {list(known)}", f"it was {channel!r}")
    rows = np.concatenate([each[channel] for each in residuals if channel in each])
    count = np.count_nonzero(np.isfinite(rows), axis=0)
    total = np.nansum(rows**2, axis=0)
    return np.sqrt(np.where(count > 0, total / np.maximum(count, 1), np.nan))
