"""Random systems in quasi-velocities, each at one consistent state.

U has a regular dU/dv, which is singular at the state for some systems. Some quasi-velocities vanish
(constraints), and additional rows may repeat this. Kinematics v = B u + c are square, or they are
tall and satisfy the rows identically. L is a function of v or of u.
"""

import numpy as np

from bench.fuzz._random_mechanisms import Mechanism, Quasi, Row, _Drawing
from bench.fuzz._random_systems import Trees, text


class _Speeds(_Drawing):
    """The generator of quasi-velocities."""

    def affine(self, name: str, i: int, units: tuple[float, ...]) -> str:
        """A component affine in these velocities in units, from a regular matrix."""
        rng, trees = self.rng, self.trees
        own = f"(1.6 + 0.4 * jnp.sin({text(trees.grow(1))}))"
        parts = [f"{own} * {name}[{i}] / {units[i]!r}"]
        for j in range(len(units)):
            if j != i and rng.random() < 0.5:
                slope = f"0.3 * jnp.tanh({text(trees.grow(1))})"
                parts.append(f"{slope} * {name}[{j}] / {units[j]!r}")
        if rng.random() < 0.5:
            parts.append(f"0.5 * ({text(trees.grow(1))})")
        return " + ".join(parts)

    def by_u(self) -> tuple[Quasi, list[Row]]:
        """U with some constrained components, and rows that depend on these."""
        rng, n = self.rng, self.n
        parts = [self.affine("v", i, self.units) for i in rng.permutation(n)]
        bound = ()
        if n > 1 and rng.random() < 0.5:
            bound = tuple(sorted(rng.choice(n, size=int(rng.integers(1, n)), replace=False)))
            bound = tuple(int(k) for k in bound)
        singular = rng.random() < 0.12
        if singular:
            free = [k for k in range(n) if k not in bound]
            k, i = int(rng.choice(free)), int(rng.integers(n))
            off = f"((q[{i}] - {self.q[i]!r}) / {self.units[i]!r})"
            others = [j for j in range(n) if j != k]
            like = f" + ({parts[int(rng.choice(others))]})" if others and rng.random() < 0.5 else ""
            parts[k] = f"jnp.sin({off}) * ({parts[k]}){like}"
        u = tuple(f"{self.factor()!r} * ({part})" for part in parts)
        base = [Row("Pfaffian", f"({parts[k]})") for k in bound]
        dependent = []
        if base and rng.random() < 0.4:
            dependent = [self.following(base)]
        if rng.random() < 0.1:
            dependent.append(Row("Pfaffian", self.void("Pfaffian"), "void"))
        return Quasi(u, None, n, bound, "v", singular), dependent

    def square(self) -> tuple[Quasi, list[Row]]:
        """Kinematics without rows."""
        n = self.n
        order = self.rng.permutation(n)
        parts = [f"{self.units[i]!r} * ({self.affine('u', i, self.units)})" for i in order]
        parts = [parts[k] for k in np.argsort(order)]
        return Quasi(None, f"jnp.stack([{', '.join(parts)}])", n), []

    def tall(self) -> tuple[Quasi, list[Row]]:
        """Kinematics that satisfy the rows identically."""
        rng, n, units = self.rng, self.n, self.units
        led = sorted(int(k) for k in rng.choice(n, size=int(rng.integers(1, n)), replace=False))
        free = [k for k in range(n) if k not in led]
        of_free = tuple(units[k] for k in free)
        trees = Trees(rng, units, self.trees.time, self.trees.one, self.trees.two, tuple(free))
        speeds = ", ".join(
            f"{units[k]!r} * ({self.affine('u', j, of_free)})" for j, k in enumerate(free)
        )
        rows, of_led = [], {}
        for k in led:
            if rng.random() < 0.5:
                written = text(trees.grow(2))
                g = f"0.5 * ({written}) + {self.number()!r} * {self.trees.over('q', free[0])}"
                phi = f"({self.trees.over('q', k)} - ({g})"
                rows.append(Row("holonomic", f"{phi} - {self.at_state(phi + ')')!r})"))
                along = (
                    "jnp.zeros_like(q).at[jnp.array([" + ", ".join(map(str, free)) + "])].set(w)"
                )
                rate = f"jax.jvp(lambda t, q: {g}, (t, q), (jnp.ones_like(t), {along}))[1]"
                of_led[k] = f"{units[k]!r} * ({rate})"
                continue
            chosen = rng.choice(len(free), size=int(rng.integers(1, len(free) + 1)), replace=False)
            slopes = [f"(0.7 + 0.5 * ({text(self.trees.grow(1))}))" for _ in chosen]
            rest = f"0.3 * ({text(self.trees.grow(1))})" if rng.random() < 0.5 else "0.0"

            def written_in(name: str, place: dict[int, int], s=slopes, c=chosen, r=rest) -> str:
                terms = [
                    f"{slope} * {name}[{place[j]}] / {of_free[j]!r}"
                    for slope, j in zip(s, map(int, c), strict=True)
                ]
                return " + ".join([*terms, r])

            v = written_in("v", dict(enumerate(free)))
            rows.append(Row("Pfaffian", f"({self.trees.over('v', k)} - ({v}))"))
            of_led[k] = f"{units[k]!r} * ({written_in('w', {j: j for j in range(len(free))})})"
        whole = [f"w[{free.index(k)}]" if k in free else of_led[k] for k in range(n)]
        body = f"(lambda w: jnp.stack([{', '.join(whole)}]))(jnp.stack([{speeds}]))"
        if rng.random() < 0.4:
            rows.append(self.following(rows))
        return Quasi(None, body, len(free)), rows


def draw(seed: int, reach: float = 12.0, smooth: bool = False) -> Mechanism:
    """The system of a seed.

    Args:
        seed: of the random numbers.
        reach: decades of the units and of the energies.
        smooth: whether L must be smooth.
    """
    by = _Speeds(seed, reach, smooth)
    rng = by.rng
    kind = rng.random()
    if kind < 0.5:
        quasi, rows = by.by_u()
    elif kind < 0.7 or by.n == 1:
        quasi, rows = by.square()
    else:
        quasi, rows = by.tall()
    square = quasi.size == by.n
    if square and not quasi.singular and rng.random() < 0.4:
        quasi = quasi._replace(written_in="u")
    return by.mechanism(by.lagrangian(), rows, quasi=quasi)
