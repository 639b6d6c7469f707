"""Findings about a system from its derived equations on the graph."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from jaxlag._lowering._graph._eliminate import blocks
from jaxlag._lowering._graph._expression import Node
from jaxlag._lowering._graph._traversal import dependencies
from jaxlag._lowering._symbolic._bias_forms import degree
from jaxlag._lowering._symbolic._symbolic_system import Equations, SymbolicSystem


class Findings(NamedTuple):
    """Findings that hold for all values of the params; coordinates by their index.

    Attributes:
        cyclic: coordinates that the simplified L does not contain.
        mass_depends: inputs on which M depends: ("q", i), ("v", i) or ("t", 0).
        mass_blocks: coordinates coupled by M.
        subsystems: coordinates coupled by M, h or forces.
        bias_zero: whether h = 0.
        separable: whether L = T(v) - V(q) with a constant M.
        quadratic: whether L is a polynomial of degree 2 in v.
        linear: whether M is constant and Q - h a polynomial of first degree in (q, v).
    """

    cyclic: tuple[int, ...]
    mass_depends: frozenset[tuple[str, int]]
    mass_blocks: tuple[tuple[int, ...], ...]
    subsystems: tuple[tuple[int, ...], ...]
    bias_zero: bool
    separable: bool
    quadratic: bool
    linear: bool

    @property
    def mass_constant(self) -> bool:
        """Whether M depends on params alone."""
        return not self.mass_depends


def find(scene: SymbolicSystem, equations: Equations) -> Findings:
    """Read the structure of a system from its equations."""
    graph, n = scene.graph, len(scene.q)
    M, h = equations.mass, equations.bias
    effort = (
        h if scene.force is None else [graph.sub(a, b) for a, b in zip(h, scene.force, strict=True)]
    )
    reached = dependencies([equations.lagrangian, *effort, *h, *(x for row in M for x in row)])
    in_mass = _state(reached[x] for row in M for x in row)
    in_bias = _state(reached[x] for x in h)
    constant = not in_mass
    quadratic = degree([equations.lagrangian], scene.v) <= 2.0
    in_L = reached[equations.lagrangian]
    return Findings(
        cyclic=tuple(i for i in range(n) if ("q", i) not in in_L),
        mass_depends=in_mass,
        mass_blocks=tuple(map(tuple, blocks(M, graph.zero))),
        subsystems=_coupled(scene, M, effort, reached),
        bias_zero=all(x is graph.zero for x in h),
        separable=quadratic and constant and not any(name in ("v", "t") for name, _ in in_bias),
        quadratic=quadratic,
        linear=constant and degree(effort, [*scene.q, *scene.v]) <= 1.0,
    )


def _state(inputs: Iterable[frozenset[tuple[str, int]]]) -> frozenset[tuple[str, int]]:
    return frozenset(x for found in inputs for x in found if x[0] in ("t", "q", "v"))


def _coupled(
    scene: SymbolicSystem, M: Sequence[Sequence[Node]], effort: Sequence[Node], reached: dict
) -> tuple[tuple[int, ...], ...]:
    n, zero = len(scene.q), scene.graph.zero
    linked = [[i == j for j in range(n)] for i in range(n)]

    def link(these: Iterable[int]) -> None:
        first, *rest = set(these)
        for other in rest:
            linked[first][other] = linked[other][first] = True

    for i in range(n):
        link([i, *(k for name, k in reached[effort[i]] if name in ("q", "v"))])
        for j in range(n):
            if M[i][j] is not zero:
                link([i, j, *(k for name, k in reached[M[i][j]] if name in ("q", "v"))])
    one = scene.graph.one
    pattern = [[one if linked[i][j] else zero for j in range(n)] for i in range(n)]
    return tuple(map(tuple, blocks(pattern, zero)))
