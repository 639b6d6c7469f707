"""Verification of scalar programs against the array program."""
