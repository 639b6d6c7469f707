"""A system as scalar expressions, and the code generated from it."""

from collections.abc import Sequence
from typing import NamedTuple

from jaxlag._lowering._graph._expression import Graph, Node
from jaxlag._lowering._graph._straight_line import Program
from jaxlag._lowering._symbolic._constraint_solve import Constrained, SymbolicRows
from jaxlag._lowering._symbolic._projection_program import ProjectionCode


class Kinematics(NamedTuple):
    """The relation of u and v, as scalars; at least one of U and V is given.

    Attributes:
        u: all quasi-velocities.
        free: the ones in the state.
        bound: the others.
        U: u as functions of v.
        V: v as functions of u.
        in_u: whether L is a function of u instead of v.
    """

    u: Sequence[Node]
    free: Sequence[Node]
    bound: Sequence[Node]
    U: Sequence[Node] | None
    V: Sequence[Node] | None
    in_u: bool


class SymbolicSystem(NamedTuple):
    """A system as scalars: L and Q as functions of the inputs t, q, v.

    `array_operations` is the number of operations on arrays in L as it is written.
    """

    graph: Graph
    t: Node
    q: Sequence[Node]
    v: Sequence[Node]
    lagrangian: Node
    force: Sequence[Node] | None
    constrained: Constrained | None = None
    kinematics: Kinematics | None = None
    array_operations: int = 0


class Equations(NamedTuple):
    """M a + h = Q, and the straight-line code for a.

    With quasi-velocities in the state, a stands for (v, u'), and M, h and Q for their projections
    in the equations of u', with Q on the left side.

    Attributes:
        lagrangian: L, simplified if possible.
        mass: M, n rows.
        bias: h; with quasi-velocities h - Q.
        accelerations: a.
        program: straight-line code for a.
        form: the form of h, as text.
        rows: A and gamma, if there are constraints.
        surface: their projection.
        lam: multipliers, if forces depend on them.
        velocity: code for v alone, if the state has quasi-velocities.
        determinants: code for their determinants, without constant ones; None if it is too
            long.
    """

    lagrangian: Node
    mass: list[list[Node]]
    bias: list[Node]
    accelerations: list[Node]
    program: Program
    form: str
    rows: SymbolicRows | None = None
    surface: ProjectionCode | None = None
    lam: list[Node] | None = None
    velocity: Program | None = None
    determinants: Program | None = None

    def code(self, name: str) -> Program | None:
        """The code whose prelude has this name in `ScalarSolveConstants`."""
        own = {
            "acceleration": self.program,
            "rates": self.velocity,
            "determinants": self.determinants,
        }
        return own[name] if name in own else getattr(self.surface, name)
