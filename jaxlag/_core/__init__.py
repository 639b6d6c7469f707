"""Helpers of all packages: errors, arrays, batching, maps with derivatives."""
