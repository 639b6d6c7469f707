"""The text of `System.explain`."""

from typing import TYPE_CHECKING

from jaxlag import _xla
from jaxlag._linalg import UNROLL_UP_TO
from jaxlag._lowering import Structure

if TYPE_CHECKING:
    from jaxlag._system import System


def _list(names: frozenset[str]) -> str:
    order = [name for name in ("t", "q", "v", "params") if name in names]
    return ", ".join(order) if order else "nothing"


def explain(system: "System", structure: Structure) -> str:
    """What was found in `system` and what follows for the compiled program."""
    n = system.size
    forces = [f"{force.name} ({type(force).__name__})" for force in system.forces]
    lines = [
        f"coordinates   {n}: {', '.join(system.coordinates.labels)}",
        f"lagrangian    depends on {_list(structure.lagrangian)}; "
        + ("explicit time" if structure.explicit_time else "no explicit time, so dL/dt is skipped"),
        f"mass matrix   depends on {_list(structure.mass)}; "
        + ("L is quadratic in v" if structure.quadratic else "L is not quadratic in v"),
        "bias          "
        + ("zero" if structure.bias_zero else f"depends on {_list(structure.bias)}"),
        f"forces        {', '.join(forces) if forces else 'none, so no force code is compiled'}",
        "constraints   none, so no multipliers are computed",
        "lowering      array program: M by batched forward-over-reverse columns, h by one "
        "forward derivative of (dL/dq, dL/dv)",
        "mass solve    one factorisation per evaluation, "
        + ("unrolled" if n <= UNROLL_UP_TO else f"by library Cholesky (n > {UNROLL_UP_TO})"),
        f"small loops   {_xla.report()}",
    ]
    return "\n".join(lines)
