"""The text of `System.explain`."""

from collections.abc import Iterable
from typing import TYPE_CHECKING

from jaxlag import _xla
from jaxlag._linalg import UNROLL_UP_TO
from jaxlag._lowering import Equations, Lowered, Structure, find

if TYPE_CHECKING:
    from jaxlag._system import System


def _list(names: frozenset[str]) -> str:
    order = [name for name in ("t", "q", "v", "params") if name in names]
    return ", ".join(order) if order else "nothing"


def explain(system: "System", structure: Structure, lowered: Lowered | None) -> str:
    """What was found in `system` and what follows for the compiled program.

    Args:
        system: the declaration.
        structure: dependencies of its terms.
        lowered: its scalar program, or why there is none; None where it was not asked for.
    """
    forces = [f"{force.name} ({type(force).__name__})" for force in system.forces]
    lines = [
        f"coordinates   {system.size}: {', '.join(system.coordinates.labels)}",
        f"lagrangian    depends on {_list(structure.lagrangian)}; "
        + ("explicit time" if structure.explicit_time else "no explicit time, so dL/dt is skipped"),
        f"mass matrix   depends on {_list(structure.mass)}; "
        + ("L is quadratic in v" if structure.quadratic else "L is not quadratic in v"),
        "bias          "
        + ("zero" if structure.bias_zero else f"depends on {_list(structure.bias)}"),
        f"forces        {', '.join(forces) if forces else 'none, so no force code is compiled'}",
        "constraints   none, so no multipliers are computed",
    ]
    if lowered is not None and lowered.equations is not None:
        lines += _scalar(system, lowered, lowered.equations)
    else:
        lines += _array(system, "as declared" if lowered is None else lowered.reason)
    return "\n".join([*lines, f"small loops   {_xla.report()}"])


def _scalar(system: "System", lowered: Lowered, equations: Equations) -> list[str]:
    program, labels = equations.program, system.coordinates.labels
    assert lowered.scene is not None
    found = find(lowered.scene, equations)

    def named(indices: Iterable[int]) -> str:
        return ", ".join(labels[i] for i in indices)

    facts = []
    if found.cyclic:
        facts.append(f"cyclic: {named(found.cyclic)}")
    if found.mass_constant:
        facts.append("M constant, factored once per solve")
    else:
        inputs = sorted(labels[i] + ("'" if name == "v" else "") for name, i in found.mass_depends)
        facts.append(f"M depends on {', '.join(inputs)}")
    if system.size > 1 and len(found.mass_blocks) == system.size:
        facts.append("M diagonal")
    elif len(found.mass_blocks) > 1:
        facts.append("M in blocks: " + " | ".join(map(named, found.mass_blocks)))
    if len(found.subsystems) > 1:
        facts.append("decoupled: " + " | ".join(map(named, found.subsystems)))
    if found.separable:
        facts.append("L = T(v) - V(q)")
    if found.linear:
        facts.append("equations linear")
    functions = program.operations - program.count(*_ARITHMETIC)
    return [
        f"structure     {'; '.join(facts)}",
        f"lowering      scalar program: {program.operations} operations for a, {functions} of them "
        f"functions, {program.count('div')} divisions; {len(program.prelude)} more once per solve",
        f"              h from {equations.form}; {lowered.reason}",
        "mass solve    along the nonzeros of M, on scalars",
    ]


_ARITHMETIC = ("add", "sub", "mul", "div", "neg", "select", "gt", "ge", "lt", "le", "eq", "ne")


def _array(system: "System", reason: str) -> list[str]:
    n = system.size
    return [
        f"lowering      array program ({reason}): M by batched forward-over-reverse columns, h by "
        "one forward derivative of (dL/dq, dL/dv)",
        "mass solve    one factorisation per evaluation, "
        + ("unrolled" if n <= UNROLL_UP_TO else f"by library Cholesky (n > {UNROLL_UP_TO})"),
    ]
