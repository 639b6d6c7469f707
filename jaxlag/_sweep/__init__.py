"""Sweeps: many trajectories of one system with different starts, params and inputs."""
