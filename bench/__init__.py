"""Benchmarks of jaxlag: `python -m bench list`, `python -m bench NAME [--quick]`.

Each module of this package is one benchmark. `run(quick)` measures and returns a `Report` of table
rows, targets and references. Targets are judged: one missed target makes the exit status 1.
References are printed and not judged. A full run is stored in `bench/results/NAME.json`, which
holds the latest run for each version of jax. A quick run has fewer cases and repeats. It is stored
in `bench/results/quick/NAME.json`, which is not in git.

Limits: the benchmarks measure small systems on one CPU. Ratios within a run are valid on other
machines, milliseconds are not. Times among the references come from another machine.
"""
