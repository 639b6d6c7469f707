"""User functions as traced programs: their arguments, captured values and results."""
