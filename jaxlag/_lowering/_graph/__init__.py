"""Expressions of scalars: a graph, its simplification, elimination, its program."""
