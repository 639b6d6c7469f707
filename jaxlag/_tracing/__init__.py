"""Functions of the user's as programs: what they take, read and return."""
