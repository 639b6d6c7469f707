"""Checks of derivatives of L = v^2/2 - potential(q, params), and the expected findings."""

import inspect
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
from jax import lax

import jaxlag as jl
from jaxlag import testing
from tests._user import unchecked  # noqa: F401

PARAMS = {"k": 1.5, "c": 0.0, "n": 3}
Q, V = [0.8, 0.6], [0.3, -0.4]


@cache
def checked(potential):
    """Reports that several tests share."""
    return check(potential)


def check(potential, params=PARAMS, q=Q, v=V, **rest):
    """The report on L = v^2/2 - potential(q, params)."""
    return testing.check_derivatives(system_of(potential, **rest), q, v, params)


def system_of(potential, **rest):
    def lagrangian(t, q, v, params):
        return 0.5 * v @ v - params["k"] * potential(q, params)

    return jl.System(lagrangian, coordinates=("x", "y"), **rest)


def line_of(function, text):
    """The only line of a function's source that contains a text."""
    lines, start = inspect.getsourcelines(inspect.unwrap(function))
    (line,) = [start + i for i, line in enumerate(lines) if text in line]
    return line


def places(report):
    """{(primitive, file, line)} of all findings."""
    return {(f.primitive, Path(f.file).name, f.line) for f in report.findings}


def here(primitive, function, text):
    return {(primitive, file_of(function), line_of(function, text))}


def file_of(function):
    """Name of the file that contains a function."""
    return Path(inspect.getfile(inspect.unwrap(function))).name


def length(q, params):
    stretched = jnp.sqrt(1.0 + q[0] ** 2)
    return stretched + jnp.sqrt(q[0] ** 2 + q[1] ** 2)  # wrong


def scan_body(total, x):
    y = jnp.cos(x)
    return total + y * jnp.sqrt(x * x), y  # wrong


def scanned(q, params):
    total, entries = lax.scan(scan_body, jnp.zeros(()), q)
    return total + jnp.sum(entries)


def rule_of(derivative):
    """q0 sin(q0) with a rule for the given derivative."""

    @jax.custom_jvp
    def function(x):
        return x * jnp.sin(x)

    @function.defjvp
    def rule(primals, tangents):
        (x,), (dx,) = primals, tangents
        return function(x), derivative(x) * dx

    return function


def right(x):
    return jnp.sin(x) + x * jnp.cos(x)
