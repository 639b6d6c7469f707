"""Reference files: motions and states of rest, read strictly and compared with the engine."""
