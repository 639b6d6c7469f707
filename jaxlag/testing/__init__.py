"""Checks that users apply to their declarations."""

from jaxlag.testing._check_derivatives import STATES as STATES
from jaxlag.testing._check_derivatives import Finding as Finding
from jaxlag.testing._check_derivatives import Report as Report
from jaxlag.testing._check_derivatives import check_derivatives as check_derivatives
