"""Check that code gives no warning."""

import warnings
from contextlib import contextmanager


@contextmanager
def no_warning():
    """Warnings are errors, except JAX's about a cached program that another process is writing."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message="Error reading persistent compilation cache")
        yield
