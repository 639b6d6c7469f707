"""Timing, child processes and result files, for all benchmarks."""
