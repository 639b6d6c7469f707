"""Equations of motion and their solutions in numbers of many digits, apart from the engine."""
