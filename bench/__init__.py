"""Benchmarks of jaxlag: `python -m bench list`, `python -m bench NAME [--quick]`.

Each module of this package is one benchmark: `run(quick)` measures and returns a `Report` of
rows, targets (judged: one missed makes the exit status 1) and references (printed, not judged).
A full run is kept in `bench/results/NAME.json`, which holds the latest run on every version of
jax; a quick run, of fewer cases and repeats, in `bench/results/quick/NAME.json`, not in git.

What the numbers cannot show: small systems on one CPU. Ratios within a run carry over to
another machine, milliseconds do not; references in time come from another machine.
"""
