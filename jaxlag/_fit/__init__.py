"""Params from measurements: multiple shooting, its statistics, predictions."""
