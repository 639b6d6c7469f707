"""Families of tests: a few members always run, the others with -m full."""

import pytest


def mostly_full(values, *plain):
    """Values to parametrize by; those that are not among `plain` are marked full."""

    def marked_full(x):
        return pytest.param(*(x if isinstance(x, tuple) else (x,)), marks=pytest.mark.full)

    return [x if x in plain else marked_full(x) for x in values]
