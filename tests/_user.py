"""The package as its users run it: jaxtyping's checks, on in the tests, are off for them."""

import jaxtyping
import pytest


@pytest.fixture
def unchecked():
    """Switches the run-time type checks off, for arguments whose type is wrong on purpose."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
