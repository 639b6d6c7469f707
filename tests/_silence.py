"""Tests of what is not warned about."""

import warnings
from contextlib import contextmanager


@contextmanager
def no_warning():
    """Warnings are errors, but JAX's of a kept program that another process is just writing."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message="Error reading persistent compilation cache")
        yield
