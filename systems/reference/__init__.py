"""Reference files: motions and states of rest, read strictly and held against the engine."""
