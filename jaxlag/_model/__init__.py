"""Declarations of the user: coordinates, forces, constraints, quasi-velocities, inputs."""
