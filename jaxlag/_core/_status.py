"""Status: the outcome of a trajectory, and the advice for each outcome."""

from enum import IntEnum


class Status(IntEnum):
    """Outcome of one trajectory, stored as int32 in `Solution.status`.

    `ok` is the only success. All other values come with `last_time`, `last_state`
    and `where`, the index of the coordinate or constraint row concerned, for singular kinematics
    of the quasi-velocity; -1 if none.
    """

    ok = 0
    max_steps = 2
    step_below_resolution = 3
    nonfinite = 4
    mass_singular = 5
    rank_change = 6
    contradictory_rows = 7
    no_reaction_solution = 8
    kinematics_singular = 9
    projection_failed = 10
    implicit_solve_failed = 11
    inconsistent_start = 12
    input_range = 13
    bad_value = 14


CONCERNS_ROW = {
    Status.rank_change,
    Status.contradictory_rows,
    Status.no_reaction_solution,
    Status.projection_failed,
    Status.inconsistent_start,
}
"""Outcomes whose `where` is the index of a constraint row."""


ADVICE = {
    Status.max_steps: (
        "Raise max_steps, loosen rtol and atol, or shorten ts. motion.explain() shows what limited "
        "the steps."
    ),
    Status.step_below_resolution: (
        "The step shrank below the resolution of time: a singularity, a discontinuity without an "
        "input knot at its time, atol = 0 where a component is 0, or a tolerance below the "
        "rounding of the dtype."
    ),
    Status.nonfinite: ("A declared function is not finite there: check its domain."),
    Status.mass_singular: (
        "The mass matrix d2L/dv2 is not positive definite there: give this coordinate inertia, "
        "or drop it."
    ),
    Status.kinematics_singular: (
        "There dU/dv is singular: this quasi-velocity depends on the others or vanishes, and u "
        "does not determine v (pitch at 90 degrees, a wheel steered by 90 degrees). Near this "
        "state use other coordinates or quasi-velocities, or formulation='multipliers', which "
        "passes this state if the motion continues through it."
    ),
    Status.rank_change: (
        "There this constraint row became dependent on the others, or independent of them: a dead "
        "point or a change point, where the motion may have more than one continuation. Unless "
        "change_points='stop', it is passed if branches cross, states are projected and forces "
        "read no multipliers. Otherwise start beyond it, or add a row that selects one branch. "
        "If rows are redundant, the rows to solve with are chosen at the start: then start again "
        "from motion.last_state."
    ),
    Status.no_reaction_solution: (
        "No reaction is consistent with the forces that depend on it: the contact lifts off, its "
        "sliding stops or reverses, or friction is so strong that there is no solution (Painleve)."
    ),
    Status.contradictory_rows: (
        "No motion satisfies this constraint row together with the others: drop or correct one."
    ),
    Status.projection_failed: (
        "The state was too far from this constraint to be projected: reduce rtol and atol."
    ),
    Status.inconsistent_start: (
        "q0 and v0 do not satisfy this constraint: pass assemble=True, or q0, v0 from jl.assemble."
    ),
    Status.implicit_solve_failed: (
        "The implicit solver's equations did not converge: loosen rtol and atol, or give a shorter "
        "first step dt0."
    ),
    Status.input_range: "Extend the input's table to cover ts, or shorten ts.",
    Status.bad_value: "Start, ts, tolerances and dt must be finite and within their bounds.",
}


ADVICE_FIXED = {
    Status.max_steps: "Raise max_steps, lengthen dt, or shorten ts.",
    Status.nonfinite: (
        "A declared function is not finite there: check its domain, and "
        "whether dt is short compared with the fastest motion. If dt is too long, the solution "
        "grows without bound."
    ),
    Status.projection_failed: (
        "The state was too far from this constraint to be projected: reduce dt."
    ),
    Status.implicit_solve_failed: ("The implicit solver's equations did not converge: reduce dt."),
}
"""Different advice for fixed steps, which have no tolerances."""

ADVICE_SHARP = {
    Status.max_steps: (
        "Raise max_steps, or shorten ts. motion.explain() shows what limited the steps."
    ),
}
"""Advice if forces change over a short distance, which a looser tolerance would miss."""

ADVICE_SPARSE = (
    "With traced params (jax.jit, jax.grad, jax.vmap), rows that couple this coordinate with "
    "others do not replace inertia, as M is sparse."
)
"""Further advice if M is singular and is positive definite on the constraints."""
