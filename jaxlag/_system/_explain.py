"""The text of `System.explain`."""

from collections.abc import Iterable, Sequence

import jax

from jaxlag._core import _xla
from jaxlag._core._batching import LANES, MOST, VECTORIZED_FROM
from jaxlag._linalg._mass_solve import LOOP_UP_TO, UNROLL_UP_TO
from jaxlag._lowering import (
    Compressed,
    Equations,
    Lowered,
    Program,
    SparsityFound,
    Structure,
    find,
)
from jaxlag._model._constraints import ConstraintRows
from jaxlag._system._state_functions import AbstractQuantities
from jaxlag.solvers import Dopri8
from jaxlag.solvers._explicit import WRITTEN_OUT, in_loop_over_stages


def _list(names: frozenset[str]) -> str:
    order = [name for name in ("t", "q", "v", "params") if name in names]
    return ", ".join(order) if order else "nothing"


def explain(
    system: AbstractQuantities,
    structure: Structure,
    lowered: Lowered | None,
    rows: ConstraintRows,
    sparse: SparsityFound | None,
) -> str:
    """The properties found in `system`, and their effects on the compiled program.

    Args:
        system: the declaration.
        structure: dependencies of its terms.
        lowered: its scalar program, or why there is none; None if it was not requested.
        rows: its constraint rows.
        sparse: which entries of M and A may differ from zero; None with a scalar program.
    """
    forces = [f"{force.name} ({type(force).__name__})" for force in system.forces]
    lines = [
        f"coordinates   {system.size}: {', '.join(system.coordinates.labels)}",
        f"lagrangian    depends on {_list(structure.lagrangian)}; "
        + ("explicit time" if structure.explicit_time else "no explicit time, so dL/dt is skipped"),
        f"mass matrix   depends on {_list(structure.mass)}",
        "bias          "
        + ("zero" if structure.bias_zero else f"depends on {_list(structure.bias)}"),
        f"forces        {', '.join(forces) if forces else 'none, so no force code is compiled'}",
        *_states(system),
        *_quasi(system),
        *_constraints(rows, system.quasi is not None),
    ]
    if lowered is not None and lowered.equations is not None:
        lines += _scalar(system, lowered, lowered.equations)
    else:
        assert sparse is not None
        reason = "as declared" if lowered is None else lowered.reason
        lines += _array(system, structure, reason, sparse)
    return "\n".join([*lines, f"small loops   {_xla.report()}"])


def _states(system: AbstractQuantities) -> list[str]:
    if system.states is None:
        return []
    return [f"states        {', '.join(system.states.layout.labels)}, integrated with (q, v)"]


def _quasi(system: AbstractQuantities) -> list[str]:
    quasi = system.quasi
    if quasi is None:
        return []
    free = [name for name in quasi.names if name not in quasi.constrained]
    zero = f", {', '.join(quasi.constrained)} being 0" if quasi.constrained else ""
    return [f"quasi         {', '.join(free)} and q form the state{zero}"]


def _constraints(rows: ConstraintRows, quasi: bool) -> list[str]:
    if not rows.size:
        return ["constraints   none, so no multipliers are computed"]
    kinds = zip(rows.labels, rows.holonomic, rows.driven, strict=True)
    descriptions = [
        f"{label} ({'holonomic' if holonomic else 'Pfaffian'}{', driven' if driven else ''})"
        for label, holonomic, driven in kinds
    ]
    return [
        f"constraints   {rows.size} rows: {', '.join(descriptions)}",
        "              by formulation='quasi' they hold without multipliers"
        if quasi
        else "              lam eliminated with M; states projected after every step"
        + ("; dependent rows left out from the start" if rows.size > 1 else ""),
    ]


def _scalar(system: AbstractQuantities, lowered: Lowered, equations: Equations) -> list[str]:
    program, labels = equations.program, system.coordinates.labels
    assert lowered.scene is not None
    if lowered.scene.kinematics is not None:
        return _in_quasi(lowered, equations)
    found = find(lowered.scene, equations)

    def named(indices: Iterable[int]) -> str:
        return ", ".join(labels[i] for i in indices)

    facts = []
    if found.cyclic:
        facts.append(f"cyclic: {named(found.cyclic)}")
    if found.mass_constant:
        facts.append("M constant, factored once per solve")
    else:
        facts.append(f"M depends on {', '.join(_inputs(labels, found.mass_depends))}")
    if found.quadratic:
        facts.append("L quadratic in v")
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
    return [
        f"structure     {'; '.join(facts)}",
        f"lowering      scalar program: {_operations(program, 'a')}",
        f"              h from {equations.form}; {lowered.reason}",
        "mass solve    along the nonzeros of M"
        + (" and A" if system.constraints else "")
        + ", on scalars",
        _steps(len(program.body)),
        *_batches(program, projects=bool(system.constraints)),
    ]


def _inputs(labels: Sequence[str], inputs: Iterable[tuple[str, int]]) -> list[str]:
    """Names of inputs: t, x, x'."""
    marks = {"q": "", "v": "'"}
    return sorted("t" if name == "t" else f"{labels[i]}{marks[name]}" for name, i in inputs)


def _in_quasi(lowered: Lowered, equations: Equations) -> list[str]:
    """The same for a state of quasi-velocities."""
    operations = _operations(equations.program, "v and u'")
    return [
        f"lowering      scalar program: {operations}",
        f"              equations {equations.form}; {lowered.reason}",
        "mass solve    along the nonzeros of B^T M B, on scalars",
        _steps(len(equations.program.body)),
        *_batches(equations.program),
    ]


def _operations(program: Program, what: str) -> str:
    functions = program.operations - program.count(*_ARITHMETIC)
    return (
        f"{program.operations} operations for {what}, {functions} of them functions, "
        f"{program.count('div')} divisions; {len(program.prelude)} more once per solve"
    )


def _steps(lines: int | None) -> str:
    method = Dopri8()
    if lines is None:
        return "steps         in a loop over stages: compiled once"
    size = f"{lines} lines of code times {method.stages} stages of order 8"
    if in_loop_over_stages(lines, method.stages):
        return f"steps         in a loop over stages: {size} are more than {WRITTEN_OUT}"
    return f"steps         written out stage by stage: {size}, of up to {WRITTEN_OUT}"


def _batches(program: Program, projects: bool = False) -> list[str]:
    if jax.default_backend() != "cpu":
        return ["batches       by jax.vmap: all trajectories in one loop"]
    first = f"{LANES} trajectories at a time in one loop"
    last = f"up to {MOST} by implicit methods"
    without = _why_not_vectorized(program, projects)
    if without is None:
        first += f", from {VECTORIZED_FROM} on in the lanes of a vectorized loop"
    lines = [
        f"batches       by jax.vmap: {first} (explicit methods of jaxlag, without work), {last}"
    ]
    return lines if without is None else [*lines, f"              not vectorized: {without}"]


def _why_not_vectorized(program: Program, projects: bool) -> str | None:
    """Why larger batches do not run as vectorized loops; None if they do."""
    if not _xla.vectorizes():
        return "LLVM's option for it is not in force, or not tested with this jaxlib"
    if projects:
        return "the projection onto the constraints is a loop"
    if in_loop_over_stages(len(program.body), Dopri8().stages):
        return "a step is a loop over stages"
    called = {line.data.name for line in program.body if line.op == "call"}
    unknown = ", ".join(sorted(called - _xla.ELEMENTWISE))
    return f"no vector code for {unknown}" if unknown else None


_ARITHMETIC = ("add", "sub", "mul", "div", "neg", "select", "gt", "ge", "lt", "le", "eq", "ne")


def _factorization(n: int) -> str:
    if n <= UNROLL_UP_TO:
        return "unrolled"
    if n <= LOOP_UP_TO:
        return f"in a loop over pivots (n > {UNROLL_UP_TO})"
    return f"by library Cholesky (n > {LOOP_UP_TO})"


def _array(
    system: AbstractQuantities, structure: Structure, reason: str, sparse: SparsityFound
) -> list[str]:
    often = "once per solve" if structure.mass_constant else "per evaluation"
    found = sparse.sparsity
    if found is None:
        ways = ["M by batched forward-over-reverse columns"]
        solves = f"one factorization {often}, {_factorization(system.size)}"
        if system.size > LOOP_UP_TO:
            solves += f"; matrices not sparse: {sparse.reason}"
    else:
        ways = [f"M by {_derivatives(found.of_mass)}"]
        blocks = (
            "M diagonal" if found.blocks.size == 1 else f"blocks of M of up to {found.blocks.size}"
        )
        solves = f"one factorization {often}, {blocks}"
    if not structure.bias_zero:
        ways.append("h by one forward derivative of (dL/dq, dL/dv)")
    if found is not None and found.constrained is not None:
        rows = found.constrained.rows
        ways.append(f"A by {_derivatives(found.constrained.of_rows)}")
        solves += f"; A M^-1 A^T banded, half bandwidth {rows.width} of {rows.count}"
    return [
        f"lowering      array program ({reason}): {', '.join(ways)}",
        f"mass solve    {solves}",
        _steps(None),
        "batches       by jax.vmap: all trajectories in one loop",
    ]


def _derivatives(entries: Compressed) -> str:
    count, kind = len(entries.seeds), "reverse" if entries.of_rows else "directional"
    return f"{count} {kind} derivative{'' if count == 1 else 's'}"
