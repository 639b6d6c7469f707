"""What every benchmark measures with: timing, child processes, result files."""
