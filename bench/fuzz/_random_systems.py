"""Random Lagrangians as source text, and their reduction."""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

import jaxlag as jl

Tree = tuple[Any, ...]  # (template, subtree, ...); a leaf is (text,)

# Templates may have kinks and jumps; denominators and radicands stay positive.
ONE = (
    "jnp.sin({0})",
    "jnp.cos({0})",
    "jnp.tan(0.5 * jnp.tanh({0}))",
    "jnp.tanh({0})",
    "jnp.arctan({0})",
    "jnp.arcsin(0.9 * jnp.tanh({0}))",
    "jnp.sinh(jnp.tanh({0}))",
    "jnp.cosh(jnp.tanh({0}))",
    "jnp.exp(-(({0}) ** 2))",
    "jnp.log1p(({0}) ** 2)",
    "jnp.log(2.0 + jnp.sin({0}))",
    "jnp.sqrt(1.0 + ({0}) ** 2)",
    "lax.rsqrt(1.0 + ({0}) ** 2)",
    "jnp.abs({0})",
    "jnp.sign({0}) * ({0}) ** 2",
    "jax.nn.softplus({0})",
    "jax.nn.sigmoid({0})",
    "jax.scipy.special.erf({0})",
    "jnp.expm1(jnp.tanh({0}))",
    "jnp.square({0})",
    "({0}) ** 3",
    "jnp.tanh({0}) ** 7",
    "(1.0 + ({0}) ** 2) ** 1.5",
    "(1.0 + ({0}) ** 2) ** -2",
    "1.0 / (1.5 + jnp.cos({0}))",
    "jnp.clip({0}, -1.2, 0.9)",
    "jnp.remainder({0}, 1.7)",
    "jnp.floor({0}) * ({0})",
    "jnp.cbrt(1.0 + ({0}) ** 2)",
    "-({0})",
    "lax.stop_gradient({0})",
    "smooth({0})",
    "jax.jit(jnp.sin)({0})",
    "jax.checkpoint(jnp.cos)({0})",
    "lax.fori_loop(0, 3, lambda i, x: 0.5 * jnp.sin(x) + 0.1, {0})",
    "jnp.sum(jnp.cumsum(jnp.array([1.0, 0.5], q.dtype) * ({0})))",
    "jnp.polyval(jnp.array([0.3, -1.0, 0.2], q.dtype), jnp.tanh({0}))",
)
TWO = (
    "({0}) + ({1})",
    "({0}) - ({1})",
    "({0}) * ({1})",
    "({0}) * jnp.sin({1})",
    "({0}) * ({1}) ** 2",
    "({0}) / (1.0 + ({1}) ** 2)",
    "jnp.maximum({0}, {1})",
    "jnp.minimum({0}, {1})",
    "jnp.where({0} > {1}, {0}, {1} ** 2)",
    "jnp.arctan2({0}, 1.0 + ({1}) ** 2)",
    "jnp.hypot({0}, 1.0 + ({1}) ** 2)",
    "jnp.sqrt(0.01 + ({0}) ** 2 + ({1}) ** 2)",
    "jnp.logaddexp({0}, {1})",
    "lax.cond({0} > {1}, jnp.sin, jnp.square, {0})",
    "lax.switch(jnp.int32({0} > {1}), [jnp.cos, jnp.tanh], {0})",
    "jnp.stack([{0}, {1}]) @ MATRIX.astype(q.dtype) @ jnp.stack([{1}, {0}])",
    "jnp.stack([{0}, {1}])[jnp.array([1, 0, 1])] @ jnp.array([0.5, 1.0, -2.0], q.dtype)",
    "jnp.prod(jnp.stack([{0}, {1}, 1.0 + ({0}) * ({1})]))",
    "jnp.max(jnp.stack([{0}, {1}, ({0}) * ({1})]))",
    "jnp.linalg.norm(jnp.stack([{0}, {1}, 1.0 + 0.0 * ({0})]))",
    "lax.scan(lambda c, x: (0.5 * c + x, None), {0}, jnp.stack([{1}, {0}]))[0]",
    "jnp.sum(jnp.roll(jnp.stack([{0}, {1}]), 1) * jnp.array([1.0, -0.5], q.dtype))",
    "jnp.concatenate([jnp.stack([{0}]), jnp.stack([{1}])])[::-1] @ jnp.array([1.0, 2.0], q.dtype)",
    "jnp.sum(jnp.outer(jnp.stack([{0}, {1}]), jnp.ones(2, q.dtype))[0])",
    "jax.vmap(jnp.sin)(jnp.stack([{0}, {1}])).sum()",
)


@jax.custom_jvp
def smooth(x: Any) -> Any:
    """x^2 / sqrt(1 + x^2), with a custom derivative rule."""
    return x * x / jnp.sqrt(1.0 + x * x)


@smooth.defjvp
def _smooth(primals: Any, tangents: Any) -> Any:
    (x,), (dx,) = primals, tangents
    s = 1.0 + x * x
    return smooth(x), (2.0 * x / jnp.sqrt(s) - x**3 / (s * jnp.sqrt(s))) * dx


class Drawn(NamedTuple):
    """A system drawn at random.

    Attributes:
        n: number of coordinates.
        kinetic, potential: trees of T (in addition to a positive definite part) and V.
        force: a tree for each coordinate, or none.
        masses: factors of v_i^2 / 2.
        params: leaves `a` (3,), `b` (), and `k`, a Python number.
        units: of the coordinates; states are multiplied by them.
        scale: of the energies.
        dtype: of the state.
        second: whether second derivatives are compared too; they take long to compile.
    """

    n: int
    kinetic: tuple[Tree, ...]
    potential: Tree
    force: tuple[Tree, ...]
    masses: tuple[float, ...]
    params: dict[str, Any]
    units: tuple[float, ...]
    scale: float
    dtype: str
    second: bool

    @property
    def lagrangian(self) -> str:
        """L as the user would write it."""
        squares = [f"{m!r} * v[{i}] ** 2" for i, m in enumerate(self.masses)]
        parts = [f"0.5 * ({' + '.join(squares)})", *map(text, self.kinetic)]
        return f"{self.scale!r} * ({' + '.join(parts)} - ({text(self.potential)}))"

    @property
    def written(self) -> str:
        """The system as source code."""
        source = [f"L = {self.lagrangian}", f"Q = [{', '.join(map(text, self.force))}]"]
        source += [f"{name} = {getattr(self, name)!r}" for name in ("params", "units", "dtype")]
        return "; ".join(source)

    @property
    def generalized_force(self) -> Callable:
        """The generalized force as a function."""
        components = ", ".join(f"{self.scale!r} * ({text(x)})" for x in self.force)
        return function("t, q, v, params", f"jnp.stack([{components}])".replace("p[", "params["))

    @property
    def forces(self) -> tuple[jl.GeneralizedForce, ...]:
        """The generalized force as declared."""
        return (jl.GeneralizedForce(self.generalized_force, "push"),) if self.force else ()

    @property
    def system(self) -> jl.System:
        """The declared system."""
        L = function("t, q, v, p", self.lagrangian)
        return jl.System(L, {"q": (self.n,)}, forces=self.forces)


def text(tree: Tree) -> str:
    """A tree as an expression."""
    template, *below = tree
    return template.format(*map(text, below)) if below else template


def function(arguments: str, body: str) -> Any:
    """The function with this source code."""
    space = {"jnp": jnp, "jax": jax, "lax": lax, "jl": jl, "smooth": smooth}
    space["MATRIX"] = np.array([[0.5, -1.0], [2.0, 0.25]])
    return eval(f"lambda {arguments}: {body}", space)


class Trees:
    """Random expressions of coordinates divided by their units.

    Attributes:
        rng: the random generator.
        units: of the coordinates.
        time: a leaf that depends on time, or a constant in its place.
        one, two: templates of one and of two operands.
        among: coordinates on which expressions may depend; None for all.
    """

    def __init__(
        self,
        rng: np.random.Generator,
        units: tuple[float, ...],
        time: str,
        one: tuple[str, ...] = ONE,
        two: tuple[str, ...] = TWO,
        among: tuple[int, ...] | None = None,
    ) -> None:
        self.rng, self.units, self.time, self.one, self.two = rng, units, time, one, two
        self.among = tuple(range(len(units))) if among is None else among

    def over(self, name: str, i: int) -> str:
        """A coordinate or a velocity divided by its unit."""
        unit = self.units[i]
        return f"{name}[{i}]" if unit == 1.0 else f"{name}[{i}] / {unit!r}"

    def leaf(self, speeds: bool = False) -> Tree:
        """A coordinate, a velocity if `speeds`, a parameter, time, or a number."""
        rng = self.rng
        kind = rng.random()
        i = self.among[int(rng.integers(len(self.among)))]
        if kind < 0.55:
            return (self.over("q", i),)
        if speeds and kind < 0.7:
            return (self.over("v", i),)
        if kind < 0.75:
            return (f'p["a"][{int(rng.integers(3))}]',)
        if kind < 0.82:
            return (str(rng.choice(['p["b"]', 'p["k"]'])),)
        if kind < 0.88:
            return (self.time,)
        return (repr(float(rng.choice([0.0, 1.0, -1.0, 2.0, 0.5, -0.3, 1e-8, 1e3]))),)

    def grow(self, depth: int, speeds: bool = False) -> Tree:
        """A tree of at most `depth` nested operations."""
        rng = self.rng
        if depth == 0 or rng.random() < 0.15:
            return self.leaf(speeds)
        if rng.random() < 0.5:
            return (str(rng.choice(self.one)), self.grow(depth - 1, speeds))
        return (
            str(rng.choice(self.two)),
            self.grow(depth - 1, speeds),
            self.grow(depth - 1, speeds),
        )

    def square(self, name: str = "v", without: int | None = None) -> Tree:
        """(sum of c_i(q) v_i)^2 with a positive factor, so that M stays positive definite.

        Args:
            name: of the velocities.
            without: index of a velocity that must not appear.
        """
        rng, n = self.rng, len(self.units)
        terms = []
        for i in rng.choice(n, size=int(rng.integers(1, min(n, 3) + 1)), replace=False):
            if i != without:
                terms.append((f"({{0}}) * {name}[{i}] / {self.units[i]!r}", self.grow(2)))
        if not terms:
            return ("0.0",)
        whole = " + ".join(f"{{{k}}}" for k in range(len(terms)))
        return (f"0.5 * ({whole}) ** 2", *terms)


def draw(seed: int) -> Drawn:
    """The system of a seed."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 6))
    single = bool(rng.random() < 0.3)
    units, scale = sizes(rng, n, 3.0 if single else 12.0)
    trees = Trees(rng, units, "0.7" if single else "jnp.sin(t)")
    grow, square = trees.grow, trees.square

    kinetic = [square() for _ in range(int(rng.integers(0, 3)))]
    if rng.random() < 0.4:  # gyroscopic
        i = int(rng.integers(n))
        kinetic.append((f"({{0}}) * v[{i}] / {units[i]!r}", grow(2)))
    if rng.random() < 0.2:  # not quadratic in v, with a small effect on M
        i = int(rng.integers(n))
        speed = f"(v[{i}] / {units[i]!r})"
        kinetic.append((f"0.1 * jnp.sqrt(1.0 + {speed} ** 2 + jnp.sin({{0}}) ** 2)", grow(1)))
    masses = rng.uniform(0.5, 2.0, n) / np.array(units) ** 2
    force = [grow(2, True) for _ in range(n)] if rng.random() < 0.3 else []
    dtype = "float32" if single else "float64"
    params = numbers(rng)
    potential = grow(int(rng.integers(1, 5)))
    return Drawn(
        n,
        tuple(kinetic),
        potential,
        tuple(force),
        tuple(float(f"{m:.3g}") for m in masses),
        params,
        units,
        scale,
        dtype,
        seed % 4 == 0,
    )


def sizes(rng: np.random.Generator, n: int, reach: float) -> tuple[tuple[float, ...], float]:
    """(units of the coordinates, scale of the energies), over `reach` decades, or 1."""
    spread = rng.random() < 0.5
    units = 10.0 ** rng.uniform(-reach / 2, reach / 2, n) if spread else np.ones(n)
    scale = float(10.0 ** rng.uniform(-reach, reach)) if rng.random() < 0.5 else 1.0
    return tuple(float(f"{u:.3g}") for u in units), float(f"{scale:.3g}")


def numbers(rng: np.random.Generator) -> dict[str, Any]:
    """Random params."""
    return {
        "a": [float(f"{x:.3g}") for x in rng.uniform(-1.5, 1.5, 3)],
        "b": float(f"{10.0 ** rng.uniform(-2, 2):.3g}"),
        "k": float(f"{rng.uniform(0.5, 1.5):.3g}"),
    }


def smaller(drawn: Drawn) -> Iterator[Drawn]:
    """Reduced systems, each without one part."""
    for k in range(len(drawn.kinetic)):
        yield drawn._replace(kinetic=drawn.kinetic[:k] + drawn.kinetic[k + 1 :])
    if drawn.force:
        yield drawn._replace(force=())
    if drawn.scale != 1.0:
        yield drawn._replace(scale=1.0)
    for tree in _pruned(drawn.potential):
        yield drawn._replace(potential=tree)
    for k, whole in enumerate(drawn.kinetic):
        for tree in _pruned(whole):
            parts = (*drawn.kinetic[:k], tree, *drawn.kinetic[k + 1 :])
            if len(tree) == len(whole) and tree[0] == whole[0]:  # the square remains a square
                yield drawn._replace(kinetic=parts)
    for k, whole in enumerate(drawn.force):
        for tree in _pruned(whole):
            yield drawn._replace(force=(*drawn.force[:k], tree, *drawn.force[k + 1 :]))


def _pruned(tree: Tree) -> Iterator[Tree]:
    """The tree with one of its nodes replaced by one of its subtrees or by a number."""
    template, *below = tree
    if not below:
        if template not in ("0.0", "1.0"):
            yield ("0.0",)
            yield ("1.0",)
        return
    yield from below
    for k, branch in enumerate(below):
        for other in _pruned(branch):
            yield (template, *below[:k], other, *below[k + 1 :])
