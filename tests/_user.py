"""The package as users run it: jaxtyping's checks are on in the tests and off for users."""

import jaxtyping
import pytest


@pytest.fixture
def unchecked():
    """Switch off run-time type checks, for arguments of an intentionally wrong type."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
