"""Equations of motion and their solutions in multiprecision, independent of the engine."""
