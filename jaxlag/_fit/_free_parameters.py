"""Free parameters: the selection of params to estimate, and their map from optimizer unknowns."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxlag._core._arguments import name_sequence
from jaxlag._core._errors import invalid
from jaxlag._fit._transforms import AbstractTransform, Free

NO_PRIOR = np.zeros(0, int), np.zeros(0), np.zeros(0)
"""(indices of numbers, means, standard deviations): no priors."""


SATURATED = 1e-3
"""An unknown is saturated if its effect on its numbers is below this part of the initial effect,
and its effect on the weighted residuals is below this. The numbers are then on a bound, within this
part of a standard deviation."""


class Prior(eqx.Module):
    """A Gaussian prior: the parameter is mean +- sigma.

    Args:
        mean: in the unit of the parameter; a number or the leaf's shape.
        sigma: its standard deviation, likewise, positive.

    Raises:
        ValueError: a sigma that is not positive.
    """

    mean: np.ndarray
    sigma: np.ndarray

    def __init__(self, mean: Any, sigma: Any) -> None:
        self.mean, self.sigma = np.asarray(mean, float), np.asarray(sigma, float)
        if not np.all(np.isfinite(self.mean)):
            raise invalid("Prior: mean", "be finite", f"it was {mean}")
        if not np.all((self.sigma > 0) & (self.sigma < np.inf)):
            fix = "Leave the prior out where nothing is known."
            raise invalid("Prior: sigma", "be positive and finite", f"it was {sigma}", fix)


def paths(params: Any) -> list[str]:
    """Names of the leaves: "m", "link.mass", "links[0].mass"."""
    found = jax.tree_util.tree_leaves_with_path(params)
    return [_name(path) for path, _ in found]


def _name(path: Any) -> str:
    parts = ""
    for key in path:
        if isinstance(key, jax.tree_util.SequenceKey):
            parts += f"[{key.idx}]"
        else:
            word = jax.tree_util.keystr((key,), simple=True)
            parts += f".{word}" if parts else word
    return parts or "params"


class Leaf(NamedTuple):
    """One leaf to estimate.

    Attributes:
        name: its path in params.
        index: among the leaves of params.
        shape: its shape.
        transform: map from its unknowns.
        first: index of its first unknown among all.
        indices: indices of the numbers in it, one for each unknown.
    """

    name: str
    index: int
    shape: tuple[int, ...]
    transform: AbstractTransform
    first: int
    indices: tuple[tuple[int, ...], ...]

    @property
    def columns(self) -> tuple[np.ndarray, ...]:
        """The indices, axis by axis."""
        return tuple(np.array(self.indices, int).reshape(len(self.indices), len(self.shape)).T)


class Unknowns(eqx.Module):
    """The map z -> params: u = u0 + scale z, each free leaf `transform.value(u)`, others as given.

    Attributes:
        leaves: the leaves to estimate.
        params0: all params.
        u0: unconstrained numbers of params0, (p,).
        scale: (p,), factor of z.
        reach: (p,), largest change of z in one step.
        low: (p,), lower bounds of z.
        high: (p,), upper bounds of z.
        limits: (2, p), bounds of u.
        on_bound: names of leaves that started on a bound.
    """

    leaves: tuple[Leaf, ...] = eqx.field(static=True)
    params0: Any
    u0: np.ndarray
    scale: np.ndarray
    reach: np.ndarray
    low: np.ndarray
    high: np.ndarray
    limits: np.ndarray
    on_bound: tuple[str, ...] = eqx.field(static=True)

    def params(self, z: Float[Array, " p"]) -> Any:
        """All params at z; an unknown at its bound has exactly the bound's value."""
        u = jnp.asarray(self.u0) + jnp.asarray(self.scale) * z
        if not self.plain:
            under, over = self._beyond(z)
            exact = jnp.where(under, self.limits[0], jnp.where(over, self.limits[1], u))
            u += jax.lax.stop_gradient(exact - u)
        leaves, treedef = jax.tree.flatten(self.params0)
        for leaf in self.leaves:
            own = u[leaf.first : leaf.first + len(leaf.indices)]
            leaves[leaf.index] = leaf.transform.value(own, leaf.shape)
        return jax.tree.unflatten(treedef, leaves)

    @property
    def plain(self) -> bool:
        """Whether all unknowns are the numbers themselves, without bounds."""
        return all(isinstance(leaf.transform, Free) for leaf in self.leaves)

    def held(self, z: Float[Array, " p"]) -> "Unknowns":
        """No unknowns, and the params at z."""
        nothing = np.zeros(0)
        return Unknowns(
            leaves=(),
            params0=self.params(z),
            u0=nothing,
            scale=nothing,
            reach=nothing,
            low=nothing,
            high=nothing,
            limits=np.zeros((2, 0)),
            on_bound=(),
        )

    def rescaled(self, scale: np.ndarray) -> "Unknowns":
        """The same unknowns u, in other units."""
        by = self.scale / scale
        return Unknowns(
            self.leaves,
            self.params0,
            self.u0,
            scale,
            self.reach * by,
            self.low * by,
            self.high * by,
            self.limits,
            self.on_bound,
        )

    def numbers(self, z: Float[Array, " p"]) -> Float[Array, " e"]:
        """The numbers to estimate, in their own units: as many as there are unknowns."""
        leaves = jax.tree.leaves(self.params(z))
        own = [leaves[leaf.index][leaf.columns].ravel() for leaf in self.leaves]
        return jnp.concatenate(own) if own else jnp.zeros(0)

    def speeds(self, z: Float[Array, " p"]) -> Float[Array, " p"]:
        """Effect of each unknown on the numbers, over that at z = 0."""
        by = jax.jacfwd(self.numbers)
        now, first = (jnp.linalg.norm(by(at), axis=0) for at in (z, jnp.zeros_like(z)))
        return now / first

    def at_limit(self, z: Float[Array, " p"]) -> Bool[np.ndarray, " p"]:
        """Which unknowns are at a bound, to rounding."""
        under, over = self._beyond(z)
        return np.asarray(under | over)

    def _beyond(self, z: Float[Array, " p"]) -> tuple[Array, Array]:
        """Which unknowns are at their lower bound, and which at their upper one."""
        near = 8 * jnp.finfo(float).eps * jnp.maximum(1.0, jnp.abs(z))
        return z - near <= self.low, z + near >= self.high

    @property
    def places(self) -> tuple[tuple[Leaf, tuple[int, ...]], ...]:
        """The leaf of every number, and its index in it."""
        return tuple((leaf, index) for leaf in self.leaves for index in leaf.indices)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the numbers: "m", "I[0,0]"."""
        return tuple(
            leaf.name + (f"[{','.join(map(str, index))}]" if leaf.shape else "")
            for leaf, index in self.places
        )


def unknowns(params0: Any, free: Sequence[str], transforms: Mapping[str, Any]) -> Unknowns:
    """The unknowns of the leaves in `free`, by their own name or by that of a branch.

    For a branch, such as a network, only leaves of real numbers are used.

    Raises:
        ValueError: an unknown name, a leaf without real numbers, or a transform of a leaf
            that is not free.
    """
    free = name_sequence("free", free)
    names, values = paths(params0), jax.tree.leaves(params0)
    chosen: dict[int, None] = {}
    for name in free:
        branch = f"{name}.", f"{name}["
        below = [i for i, path in enumerate(names) if path == name or path.startswith(branch)]
        if not below:
            raise invalid("free", f"name parameters among {names}", f"one was {name!r}")
        real = [i for i in below if _is_real(values[i])]
        if not real:
            must, was = "hold floating-point numbers if it is free", f"it was {values[below[0]]!r}"
            raise invalid(f"params0[{name!r}]", must, was, "Write 1.0 for 1.")
        chosen |= dict.fromkeys(real)
    for name, transform in transforms.items():
        if name not in [names[i] for i in chosen]:
            free_names = [names[i] for i in chosen]
            raise invalid(
                "transforms", f"be of free parameters {free_names}", f"one was of {name!r}"
            )
        if not isinstance(transform, AbstractTransform):
            must = "be a transform such as jl.transforms.Positive()"
            raise invalid(f"transforms[{name!r}]", must, f"it was {transform!r}")
    leaves, on_bound = [], []
    columns: list[np.ndarray] = [np.zeros((7, 0))]
    k = 0
    for i in sorted(chosen):
        value = np.asarray(values[i])
        if not np.all(np.isfinite(value)):
            raise invalid(f"params0[{names[i]!r}]", "be finite", f"it was {values[i]}")
        transform = transforms.get(names[i], Free())
        u, bound = transform.start(names[i], value)
        on_bound += [names[i]] * bound
        indices = transform.entries(value.shape)
        leaves.append(Leaf(names[i], i, value.shape, transform, k, indices))
        # Unknowns of order one: multiples of the initial size of a leaf; logarithms are not scaled.
        plain = np.isinf(transform.reach)
        size = (float(np.sqrt(np.mean(u**2))) if plain and u.size else 1.0) or 1.0
        one = np.ones(len(u))
        low, high = ((limit - u) / size for limit in transform.limits)
        least, most = (limit * one for limit in transform.limits)
        columns.append(np.stack([u, size * one, transform.reach * one, low, high, least, most]))
        k += len(u)
    params0 = jax.tree.map(lambda x: np.asarray(x) if isinstance(x, float) else x, params0)
    u0, scale, reach, low, high, *limits = np.concatenate(columns, axis=1)
    bounds = np.stack(limits)
    return Unknowns(tuple(leaves), params0, u0, scale, reach, low, high, bounds, tuple(on_bound))


def _is_real(leaf: Any) -> bool:
    return eqx.is_array_like(leaf) and np.issubdtype(np.asarray(leaf).dtype, np.floating)


def prior_rows(
    free: Unknowns, priors: Mapping[str, Any]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(indices, means, sigmas) of the numbers with a prior.

    Raises:
        ValueError: a prior of a parameter that is not free, or of another shape.
    """
    which, means, sigmas = [], [], []
    by_name = {leaf.name: leaf for leaf in free.leaves}
    for name, prior in priors.items():
        if name not in by_name:
            raise invalid(
                "priors", f"be of free parameters {list(by_name)}", f"one was of {name!r}"
            )
        if not isinstance(prior, Prior):
            must, fix = "be a jl.Prior", "Write jl.Prior(mean, sigma)."
            raise invalid(f"priors[{name!r}]", must, f"it was {prior!r}", fix)
        leaf = by_name[name]
        try:
            mean, sigma = (np.broadcast_to(x, leaf.shape) for x in (prior.mean, prior.sigma))
        except ValueError:
            must = f"hold numbers or arrays of shape {leaf.shape}"
            was = f"its mean had {prior.mean.shape}, its sigma {prior.sigma.shape}"
            raise invalid(f"priors[{name!r}]", must, was) from None
        which += range(leaf.first, leaf.first + len(leaf.indices))
        means.append(np.array([mean[index] for index in leaf.indices]))
        sigmas.append(np.array([sigma[index] for index in leaf.indices]))
    if not which:
        return NO_PRIOR
    return np.array(which), np.concatenate(means), np.concatenate(sigmas)
