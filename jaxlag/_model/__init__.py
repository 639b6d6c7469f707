"""What a user declares: coordinates, forces, constraints, quasi-velocities, inputs."""
