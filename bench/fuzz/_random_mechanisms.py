"""Random constrained systems, each at one consistent state: rows of all kinds, as source text.

Independent rows are drawn first. Then follow dependent rows (copies, combinations, rows times a
function, rates of positions), void rows, which are 0 = 0 except for rounding, and bent rows, which
depend on the others at this state alone: there the rank drops. Whether the equations at the state
have a solution is determined numerically in `_reference_solution.py`.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import jaxlag as jl
from bench.fuzz._random_systems import ONE, TWO, Drawn, Trees, function, numbers, sizes, text

_KINKED = ("abs", "sign", "clip", "remainder", "floor", "stop_gradient", "where", "cond", "switch")
_KINKED_ALSO = ("maximum", "minimum", "jnp.max(")


def _smooth(templates: tuple[str, ...]) -> tuple[str, ...]:
    fragments = (*_KINKED, *_KINKED_ALSO)
    return tuple(x for x in templates if not any(fragment in x for fragment in fragments))


SMOOTH_ONE, SMOOTH_TWO = _smooth(ONE), _smooth(TWO)
VOID = (
    "(jnp.sin({0}) ** 2 + jnp.cos({0}) ** 2 - 1.0)",
    "(({0} + {1}) ** 2 - {0} ** 2 - 2.0 * {0} * {1} - {1} ** 2)",
    "(jnp.cosh(jnp.sin({0})) ** 2 - jnp.sinh(jnp.sin({0})) ** 2 - 1.0)",
)


class Row(NamedTuple):
    """One constraint row.

    Attributes:
        kind: "holonomic" or "Pfaffian".
        text: the residual.
        role: "base", "dependent", "void" or "bent".
    """

    kind: str
    text: str
    role: str = "base"

    @property
    def arguments(self) -> str:
        """Arguments of the residual."""
        return "t, q, p" if self.kind == "holonomic" else "t, q, v, p"

    def declared(self, name: str) -> Any:
        """The row as a constraint."""
        of = jl.Holonomic if self.kind == "holonomic" else jl.Pfaffian
        return of(function(self.arguments, self.text), name)


class Quasi(NamedTuple):
    """Quasi-velocities u0, u1, ...

    Attributes:
        U: components of u as functions of v; None if `kinematics` is given.
        kinematics: components of v, as functions of u.
        constrained: indices of those that vanish.
        written_in: the velocities in L, "v" or "u".
        singular: whether u does not determine v at the state.
    """

    U: tuple[str, ...] | None
    kinematics: str | None
    size: int
    constrained: tuple[int, ...] = ()
    written_in: str = "v"
    singular: bool = False

    @property
    def declared(self) -> jl.QuasiVelocities:
        """The quasi-velocities as an object."""
        names = tuple(f"u{k}" for k in range(self.size))
        if self.U is None:
            f = function("t, q, u, p", self.kinematics or "")
            return jl.QuasiVelocities(kinematics=f, names=names)
        bound = tuple(names[k] for k in self.constrained)
        return jl.QuasiVelocities(self.rates, names, bound)

    @property
    def rates(self) -> Any:
        """U as a function."""
        return function("t, q, v, p", f"jnp.stack([{', '.join(self.U or ())}])")


class Mechanism(NamedTuple):
    """A system with constraints, or in quasi-velocities, at a state.

    Attributes:
        drawn: L, forces and params.
        rows: the declared rows; in the system, constrained quasi-velocities come before them.
        t, q, v: the state; v before it is made consistent.
        rest: a coordinate whose velocity must vanish.
        quasi: quasi-velocities.
    """

    drawn: Drawn
    rows: tuple[Row, ...]
    t: float
    q: tuple[float, ...]
    v: tuple[float, ...]
    rest: int | None = None
    quasi: Quasi | None = None

    @property
    def all_rows(self) -> tuple[Row, ...]:
        """All rows in the order of the system."""
        if self.quasi is None or self.quasi.U is None:
            return self.rows
        bound = (self.quasi.U[k] for k in self.quasi.constrained)
        return (*(Row("Pfaffian", x) for x in bound), *self.rows)

    @property
    def system(self) -> jl.System:
        """The declared system."""
        drawn, quasi = self.drawn, self.quasi
        L = function("t, q, v, p", drawn.lagrangian)
        constraints = tuple(row.declared(f"r{k}") for k, row in enumerate(self.rows))
        return jl.System(
            L,
            {"q": (drawn.n,)},
            forces=drawn.forces,
            constraints=constraints,
            quasi=None if quasi is None else quasi.declared,
            written_in="v" if quasi is None else quasi.written_in,
        )

    @property
    def written(self) -> str:
        """The mechanism as source code."""
        lines = [self.drawn.written]
        lines += [f"{row.kind} ({row.role}): {row.text}" for row in self.rows]
        if self.quasi is not None:
            lines.append(repr(self.quasi))
        lines.append(f"t, q, v = {self.t!r}, {list(self.q)!r}, {list(self.v)!r}")
        return "; ".join(lines)


def values(drawn: Drawn, dtype: Any = None) -> dict[str, Any]:
    """Params in the form for the Lagrangian."""
    own = jnp.dtype(drawn.dtype)
    to = own if dtype is None else dtype
    arrays = {name: np.asarray(drawn.params[name], own).astype(to) for name in ("a", "b")}
    k = drawn.params["k"]
    if drawn.dtype == "float32":
        k = np.asarray(k, own).astype(to)
    return {name: jnp.asarray(x) for name, x in arrays.items()} | {
        "k": k if isinstance(k, float) else jnp.asarray(k)
    }


class _Drawing:
    """The generator of rows and quasi-velocities of one system."""

    most = 4  # coordinates

    def __init__(self, seed: int, reach: float, smooth: bool) -> None:
        self.rng = rng = np.random.default_rng([seed, 38])
        self.n = n = int(rng.integers(1, self.most + 1))
        self.single = bool(rng.random() < 0.25)
        self.dtype = "float32" if self.single else "float64"
        reach = min(reach, 4.0) if self.single else reach
        self.units, scale = sizes(rng, n, reach)
        self.params = numbers(rng)
        time = "jnp.sin(jnp.asarray(t, q.dtype))" if self.single else "jnp.sin(t)"
        self.trees = Trees(rng, self.units, time, SMOOTH_ONE, SMOOTH_TWO)
        self.t = float(np.round(rng.uniform(0.0, 1.0), 3))
        self.x = rng.uniform(-1.2, 1.2, n)
        q = np.array(self.units) * self.x
        self.q = tuple(float(x) for x in q.astype(self.dtype))
        self.scale, self.smooth = scale, smooth

    def lagrangian(self, without: int | None = None, name: str = "v") -> Drawn:
        """L and forces; coordinate `without` has no inertia."""
        rng, n = self.rng, self.n
        plain = Trees(rng, self.units, "0.7" if self.single else "jnp.sin(t)")
        trees = self.trees if self.smooth else plain
        kinetic = tuple(trees.square(without=without) for _ in range(int(rng.integers(0, 2))))
        if rng.random() < 0.3:
            i = int(rng.integers(n))
            if i != without:
                kinetic += ((f"({{0}}) * {name}[{i}] / {self.units[i]!r}", trees.grow(1)),)
        masses = rng.uniform(0.5, 2.0, n) / np.array(self.units) ** 2
        if without is not None:
            masses[without] = 0.0
        potential = trees.grow(int(rng.integers(1, 4)))
        force = tuple(trees.grow(1, True) for _ in range(n)) if rng.random() < 0.3 else ()
        force = tuple((f"({{0}}) / {self.units[i]!r}", x) for i, x in enumerate(force))
        rounded = tuple(float(f"{m:.3g}") for m in masses)
        given = (self.params, self.units, self.scale, self.dtype, False)
        return Drawn(n, kinetic, potential, force, rounded, *given)

    def at_state(self, written: str) -> float:
        """The value of a function of (t, q, p) at the state."""
        given = Drawn(0, (), (), (), (), self.params, (), 1.0, self.dtype, False)
        q = jnp.asarray(self.q, self.dtype)
        found = function("t, q, p", written)(jnp.asarray(self.t), q, values(given))
        return float(np.asarray(found, self.dtype))

    def number(self) -> float:
        """A factor that is not small."""
        return float(np.round(self.rng.choice([-1.0, 1.0]) * self.rng.uniform(0.4, 1.6), 3))

    def factor(self) -> float:
        """The scale of a row."""
        decades = 3.0 if self.single else 6.0
        wide = self.rng.random() < 0.5
        return float(f"{10.0 ** self.rng.uniform(-decades, decades):.3g}") if wide else 1.0

    def holonomic(self) -> str:
        """phi in units, zero at the state."""
        rng = self.rng
        chosen = rng.choice(self.n, size=int(rng.integers(1, self.n + 1)), replace=False)
        parts = [f"{self.number()!r} * {self.trees.over('q', i)}" for i in chosen]
        parts.append(f"0.5 * ({text(self.trees.grow(2))})")
        whole = " + ".join(parts)
        return f"({whole} - {self.at_state(whole)!r})"

    def pfaffian(self) -> str:
        """A v + b in units."""
        rng, trees = self.rng, self.trees
        chosen = rng.choice(self.n, size=int(rng.integers(1, self.n + 1)), replace=False)
        parts = []
        for i in chosen:
            part = repr(self.number())
            if rng.random() < 0.6:
                part = f"({part} + 0.4 * ({text(trees.grow(2))}))"
            parts.append(f"{part} * {trees.over('v', i)}")
        if rng.random() < 0.5:
            parts.append(f"0.5 * ({text(trees.grow(1))})")
        return f"({' + '.join(parts)})"

    def base(self, count: int) -> list[Row]:
        """Rows that do not depend on one another by declaration."""
        rows = []
        for _ in range(count):
            holonomic = self.rng.random() < 0.6
            written = self.holonomic() if holonomic else self.pfaffian()
            rows.append(Row("holonomic" if holonomic else "Pfaffian", written))
        return rows

    def void(self, kind: str) -> str:
        """A row that is zero except for rounding."""
        i, j, k = (int(x) for x in self.rng.integers(self.n, size=3))
        x, y, z = (self.trees.over("q", m) for m in (i, j, k))
        speed = self.trees.over("v", k)
        shape = str(self.rng.choice(VOID)).format(f"({x})", f"({y})")
        return f"{shape} * {z if kind == 'holonomic' else speed}"

    def following(self, base: list[Row]) -> Row:
        """A row that depends on others everywhere on the constraints."""
        rng = self.rng
        chosen = base[int(rng.integers(len(base)))]
        alike = [row for row in base if row.kind == chosen.kind]
        how = rng.random()
        if how < 0.25:
            return Row(chosen.kind, f"{self.number()!r} * {chosen.text}", "dependent")
        if how < 0.5:
            parts = [f"{self.number()!r} * {row.text}" for row in alike]
            return Row(chosen.kind, f"({' + '.join(parts)})", "dependent")
        if how < 0.75 or chosen.kind == "Pfaffian":
            weight = f"(1.5 + jnp.sin({text(self.trees.grow(1))}))"
            return Row(chosen.kind, f"{weight} * {chosen.text}", "dependent")
        return Row("Pfaffian", rate_of(chosen.text), "dependent")

    def bent(self, base: list[Row]) -> tuple[Row, int]:
        """(row dependent at this state alone, coordinate along which it becomes independent)."""
        i = int(self.rng.integers(self.n))
        off = f"((q[{i}] - {self.q[i]!r}) / {self.units[i]!r}) ** 2"
        alike = [row for row in base if row.kind == "holonomic"]
        parts = [f"{self.number()!r} * {row.text}" for row in alike]
        return Row("holonomic", f"({' + '.join([*parts, off])})", "bent"), i

    def scaled(self, row: Row) -> Row:
        """The same row in other units."""
        factor = self.factor()
        return row if factor == 1.0 else row._replace(text=f"{factor!r} * ({row.text})")

    def mechanism(self, drawn: Drawn, rows: list[Row], **options: Any) -> Mechanism:
        """The mechanism, with random velocities."""
        v = np.array(self.units) * self.rng.uniform(-1.5, 1.5, self.n)
        v = tuple(float(x) for x in v.astype(self.dtype))
        return Mechanism(drawn, tuple(map(self.scaled, rows)), self.t, self.q, v, **options)


def rate_of(phi: str) -> str:
    """The rate of a position residual, as a row on velocities."""
    return f"jax.jvp(lambda t, q: {phi}, (t, q), (jnp.ones_like(t), v))[1]"


def draw(seed: int, reach: float = 12.0, smooth: bool = False) -> Mechanism:
    """The constrained system of a seed.

    Args:
        seed: of the random numbers.
        reach: decades of the units and of the energies.
        smooth: whether L must be smooth.
    """
    by = _Drawing(seed, reach, smooth)
    rng, n = by.rng, by.n
    base = by.base(int(rng.integers(1, n + 1)))
    rows, rest = list(base), None
    for _ in range(int(rng.choice([0, 1, 2], p=[0.45, 0.4, 0.15]))):
        rows.append(by.following(base))
    if rng.random() < 0.15:
        kind = str(rng.choice(["holonomic", "Pfaffian"]))
        rows.append(Row(kind, by.void(kind), "void"))
    if rng.random() < 0.12:
        row, i = by.bent(base)
        rows.append(row)
        rest = i if rng.random() < 0.5 else None
    rows = [rows[k] for k in rng.permutation(len(rows))] if rng.random() < 0.5 else rows
    massless = int(rng.integers(n)) if rng.random() < 0.15 else None
    return by.mechanism(by.lagrangian(massless), rows, rest=rest)


def smaller(mechanism: Mechanism) -> Iterator[Mechanism]:
    """Reduced mechanisms, each without one part."""
    drawn = mechanism.drawn
    for k in range(len(mechanism.rows)):
        if len(mechanism.rows) > 1:
            rows = mechanism.rows[:k] + mechanism.rows[k + 1 :]
            yield mechanism._replace(rows=rows)
    if drawn.force:
        yield mechanism._replace(drawn=drawn._replace(force=()))
    for k in range(len(drawn.kinetic)):
        left = drawn.kinetic[:k] + drawn.kinetic[k + 1 :]
        yield mechanism._replace(drawn=drawn._replace(kinetic=left))
    if drawn.scale != 1.0:
        yield mechanism._replace(drawn=drawn._replace(scale=1.0))
    if drawn.potential != ("0.0",):
        yield mechanism._replace(drawn=drawn._replace(potential=("0.0",)))
        for below in drawn.potential[1:]:
            yield mechanism._replace(drawn=drawn._replace(potential=below))
