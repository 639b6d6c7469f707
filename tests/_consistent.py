"""Random states projected onto constraints, independently of jaxlag."""

import jax
import jax.numpy as jnp


def onto_constraints(system, params, t, q, v):
    """(q, v) by steps of least norm: Newton's method for positions, one step for velocities."""

    def position(q):
        return jnp.hstack([*system.residuals(q, v, params, t=t)[0].values(), jnp.zeros(0)])

    def velocity(v):
        return jnp.hstack([*system.residuals(q, v, params, t=t)[1].values()])

    def newton_step(_, q):
        return q - jnp.linalg.pinv(jax.jacfwd(position)(q)) @ position(q)

    q = jax.lax.fori_loop(0, 20, newton_step, jnp.asarray(q))
    v = v - jnp.linalg.pinv(jax.jacfwd(velocity)(v)) @ velocity(v)
    return q, v
