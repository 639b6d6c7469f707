"""Derivatives of a motion: its steps are recorded, and swept forwards or backwards."""
