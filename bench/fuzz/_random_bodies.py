"""Random rigid bodies by poses, each system at one consistent state, as source text.

Bodies follow one another in chains or hang on the same one, by hinges, sliders and screws, one for
each coordinate. Rows keep points of two bodies, or of a body and the ground, apart by a constant
along a direction, or keep the velocity of a point out of a body axis, as of a skate. Other rows and
energies are those of all random mechanisms.
"""

import numpy as np

from bench.fuzz._random_mechanisms import Mechanism, _Drawing
from bench.fuzz._random_systems import Drawn, text

_JOINTS = "hinge", "hinge", "slider", "screw"
GROUND = "(jnp.eye(3, dtype=q.dtype), jnp.zeros(3, q.dtype))"


class _Bodies(_Drawing):
    """The generator of bodies.

    Attributes:
        poses: of every body, functions of (t, q, p); the first one is the ground.
    """

    most = 6

    def __init__(self, seed: int, reach: float, smooth: bool) -> None:
        super().__init__(seed, reach, smooth)
        rng, n = self.rng, self.n
        count = int(rng.integers(1, min(n, 3) + 1))
        ends = np.sort(rng.choice(np.arange(1, n), size=count - 1, replace=False))
        self.poses = [GROUND]
        for coordinates in np.split(np.arange(n), ends):
            pose, axes = str(rng.choice(self.poses)), rng.permutation(3)
            for i, axis in zip(coordinates, np.resize(axes, n), strict=False):
                pose = self.joint(pose, int(i), int(axis))
            self.poses.append(pose)

    def vector(self) -> str:
        """Components of a random vector, in the precision of the state."""
        numbers = ", ".join(f"{x:.3g}" for x in self.rng.uniform(-1.0, 1.0, 3))
        return f"jnp.asarray([{numbers}], q.dtype)"

    def joint(self, base: str, i: int, axis: int) -> str:
        """The pose after a joint along an axis of the base."""
        kind, x = str(self.rng.choice(_JOINTS)), self.trees.over("q", i)
        if self.rng.random() < 0.3:
            x = f"({x} + 0.3 * jnp.sin({text(self.trees.grow(1))}))"
        turned = f"R @ jl.rotation.about_{'xyz'[axis]}({x})" if kind != "slider" else "R"
        moved = f"r + R @ {self.vector()}"
        if kind != "hinge":
            moved += f" + {self.number()!r} * ({x}) * R[:, {axis}]"
        return f"(lambda R, r: ({turned}, {moved}))(*{base})"

    def lagrangian(self, without: int | None = None, name: str = "v") -> Drawn:
        """L of the bodies; some have an inertia of each coordinate, too, as of a motor."""
        rng, drawn = self.rng, super().lagrangian(without, name)
        bodies = []
        for pose in self.poses[1:]:
            a, b, c = (float(f"{x:.3g}") for x in rng.uniform(0.1, 1.0, 3))
            mass = 'p["b"]' if rng.random() < 0.3 else f"{rng.uniform(0.5, 2.0):.3g}"
            given = f"{mass}, [{b + c!r}, {a + c!r}, {a + b!r}]"
            center = f", {self.vector()}" if rng.random() < 0.5 else ""
            bodies.append(
                (
                    f"jl.energy.RigidBody({given}{center})"
                    f".kinetic(lambda t, q, p: {pose}, t, q, v, p)",
                )
            )
        masses = drawn.masses if rng.random() < 0.5 else (0.0,) * self.n
        return drawn._replace(kinetic=(*bodies, *drawn.kinetic), masses=masses)

    def point(self) -> tuple[str, str]:
        """(a point of a body, the matrix of the body's axes)."""
        pose = str(self.rng.choice(self.poses[1:]))
        return f"(lambda R, r: r + R @ {self.vector()})(*{pose})", f"{pose}[0]"

    def holonomic(self) -> str:
        """The distance of two points along a direction, less that at the state; or any row."""
        if self.rng.random() < 0.3:
            return super().holonomic()
        between = self.point()[0]
        if self.rng.random() < 0.5:
            between = f"({between} - {self.point()[0]})"
        whole = f"{between} @ {self.vector()}"
        return f"({whole} - {self.at_state(whole)!r})"

    def pfaffian(self) -> str:
        """The velocity of a point along a body axis; or any row."""
        if self.rng.random() < 0.3:
            return super().pfaffian()
        point, axes = self.point()
        rate = f"jax.jvp(lambda t, q: {point}, (t, q), (jnp.ones_like(t), v))[1]"
        return f"({rate} @ {axes} @ {self.vector()})"


def draw(seed: int, reach: float = 4.0, smooth: bool = False) -> Mechanism:
    """The bodies of a seed; some are free.

    Args:
        seed: of the random numbers.
        reach: decades of the units and of the energies.
        smooth: whether L must be smooth.
    """
    by = _Bodies(seed, reach, smooth)
    rng = by.rng
    base = by.base(int(rng.integers(0, min(by.n, 3) + 1)))
    rows = list(base)
    if base and rng.random() < 0.3:
        rows.append(by.following(base))
    return by.mechanism(by.lagrangian(), rows)
