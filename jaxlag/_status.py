"""How a trajectory ended."""

from enum import IntEnum


class Status(IntEnum):
    """Outcome of one trajectory, stored as int32 in `Solution.status`.

    `ok` is the only success. Every other value comes with `last_time`, `last_state`
    and `where` (index of the coordinate or constraint row concerned, -1 if none).
    """

    ok = 0
    stopped_by_event = 1
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


ADVICE = {
    Status.max_steps: "Raise max_steps, loosen rtol and atol, or shorten ts.",
    Status.step_below_resolution: (
        "The step shrank below the resolution of time: a singularity, a discontinuity that no "
        "input knot announces, atol = 0 where a component is 0, or a tolerance tighter than the "
        "dtype gives."
    ),
    Status.nonfinite: "The Lagrangian or a force is not finite there: check its domain.",
    Status.mass_singular: (
        "The mass matrix d2L/dv2 is not positive definite there: give this coordinate inertia, "
        "or drop it."
    ),
    Status.implicit_solve_failed: (
        "The implicit solver's equations did not converge: reduce dt or the first step dt0."
    ),
    Status.input_range: "Extend the input's table to cover ts, or shorten ts.",
    Status.bad_value: "q0, v0, ts, tolerances and dt must be finite and within their bounds.",
}
