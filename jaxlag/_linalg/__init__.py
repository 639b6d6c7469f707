"""Linear algebra of mechanics: the mass matrix, constraint rows, projections."""
