"""Log messages about long compilation."""

import logging
import time
from collections.abc import Callable
from typing import Any

import jax

from jaxlag._core._arrays import concrete
from jaxlag._simulation._problem import fallback
from jaxlag._system._system import System

LONG = 5.0  # s

_logger = logging.getLogger("jaxlag")


def timed(
    program: Any,
    system: System,
    key: Any,
    values: Any,
    clock: Callable[[], float] = time.monotonic,
) -> Any:
    """program(key, values), with a log message if its compilation took long.

    Inside a transform nothing is logged, as the program of the transform compiles as a whole.

    Args:
        program: a `QuickJit` of (key, values).
        system: the mechanical system.
        key: static part of the program's arguments.
        values: traced part.
        clock: seconds.
    """
    if not concrete(values):
        return program(key, values)
    count, start = program.programs(), clock()
    results = program(key, values)
    seconds = clock() - start
    if seconds > LONG and program.programs() > count:
        _logger.warning("%s", _message(system, seconds, fallback(key, values)))
    return results


def _message(system: System, seconds: float, reason: str | None) -> str:
    """The duration, and the one change that shortens it, unless it is made already.

    The reason why accelerations are computed on arrays follows, if there is one.

    With JAX's cache a motion of 6 links in a loop takes 9.9 s in the first process and 2.6 s in
    the second. `lowering="array"` takes between 0.9 and 1.2 of the time of compiling on five
    systems with constraints.
    """
    names = system.coordinates.labels
    shown = ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")
    config: Any = jax.config
    folder = config.jax_compilation_cache_dir if config.jax_enable_compilation_cache else None
    advice = "Set JAX_COMPILATION_CACHE_DIR to a folder: the next process then loads it from there."
    if folder:
        advice = f"It is kept in {folder} for the next process."
    return (
        f"Compiling the motion of {len(names)} coordinates ({shown}) took {seconds:.0f} s, once "
        f"for this program. {advice}"
        + (f" Its accelerations are computed on arrays: {reason}." if reason else "")
    )
