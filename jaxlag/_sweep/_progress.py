"""Progress of a sweep: a bar on a terminal, lines of the log elsewhere; an end between blocks."""

import logging
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from jaxlag._core._status import Status

EVERY = 30.0
"""Seconds between lines of the log."""
_logger = logging.getLogger("jaxlag")


class Progress:
    """What is shown while a sweep runs.

    Args:
        total: number of trajectories.
        done: number of those that are computed already.
        clock: seconds.
    """

    def __init__(self, total: int, done: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._total, self._done, self._failed, self._clock = total, done, 0, clock
        self._begun = self._said = clock()
        self._before = done
        self._bar = _bar(total, done)

    def advance(self, status: np.ndarray) -> None:
        """A block has ended, with these statuses."""
        self._done += len(status)
        self._failed += int((status != Status.ok).sum())
        if self._bar is not None:
            self._bar.set_postfix(failed=self._failed, refresh=False)
            self._bar.update(len(status))
        elif self._clock() - self._said >= EVERY:
            self._said = self._clock()
            rate = (self._done - self._before) / (self._said - self._begun)
            left = (self._total - self._done) / rate
            _logger.info(
                "Sweep: %d of %d trajectories, %.3g/s, %d failed, %.0f s left",
                *(self._done, self._total, rate, self._failed, left),
            )

    def close(self) -> None:
        """The bar stays as it is."""
        if self._bar is not None:
            self._bar.close()


def _bar(total: int, done: int) -> Any:
    """A bar of tqdm; None without it, or if nobody sees it."""
    if not (sys.stderr and sys.stderr.isatty()):
        return None
    try:
        from tqdm import tqdm
    except ImportError:
        return None
    return tqdm(total=total, initial=done, desc="sweep", unit=" trajectories", unit_scale=True)


@contextmanager
def between_blocks(advice: str) -> Iterator[Callable[[], None]]:
    """A function that raises KeyboardInterrupt if Ctrl-C was pressed since the last call.

    A second Ctrl-C raises at once. Threads other than the main one cannot receive it.

    Args:
        advice: the message.
    """
    pressed = False

    def ends(signum: int, frame: Any) -> None:
        nonlocal pressed
        if pressed:
            raise KeyboardInterrupt
        pressed = True

    def check() -> None:
        if pressed:
            raise KeyboardInterrupt(advice)

    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield check
        return
    signal.signal(signal.SIGINT, ends)
    try:
        yield check
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
