"""Stochastic gradient descent on batches of segments, with any optimizer of optax."""

from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxlag._core._arguments import positive_integer, renamed
from jaxlag._core._errors import invalid
from jaxlag._fit._multiple_shooting import FitVariables, MultipleShooting, SegmentOutputs


@final
class Descent(eqx.Module):
    """Stochastic gradient descent in `jl.fit`, for more params than least squares can handle.

    Every step takes the gradient of a batch of segments, in a new random order in every epoch. The
    starts of segments are optimized with the params. A step costs a few solves for any number of
    params. Least squares needs a derivative in the direction of each.

    Args:
        optimizer: of optax, such as `optax.adam(1e-3)`. The unit of a leaf of params is its initial
            root mean square (1 if that is 0, and for logarithms). The unit of starts of segments is
            the range of the states.
        epochs: number of passes over all segments.
        batch: segments per step; all of them if there are fewer.
        seed: seed of the order of segments.
        gap: standard deviation of the gaps between joined segments, over the range of the states.

    Raises:
        ValueError: an optimizer without `init` and `update`, numbers that are not positive.
    """

    optimizer: Any
    epochs: int = eqx.field(static=True)
    batch: int = eqx.field(static=True)
    seed: int = eqx.field(static=True)
    gap: float = eqx.field(static=True)

    @renamed(optimiser="optimizer=")
    def __init__(
        self,
        optimizer: Any,
        *,
        epochs: Any = 100,
        batch: Any = 16,
        seed: int = 0,
        gap: float | int = 1e-2,
    ) -> None:
        if not callable(getattr(optimizer, "init", None)) or not callable(
            getattr(optimizer, "update", None)
        ):
            must = "have init and update, as the optimizers of optax"
            raise invalid(
                "Descent: optimizer", must, f"it was {optimizer!r}", "Try optax.adam(1e-3)."
            )
        for name, value in (("epochs", epochs), ("batch", batch)):
            positive_integer(f"Descent: {name}", value)
        if not gap > 0:
            raise invalid("Descent: gap", "be positive", f"it was {gap!r}")
        self.optimizer, self.epochs, self.batch = optimizer, epochs, batch
        self.seed, self.gap = seed, float(gap)

    def steps(self, segments: int) -> tuple[int, int]:
        """(steps in an epoch, segments in each)."""
        batch = min(self.batch, segments)
        return segments // batch, batch

    def solves(self, segments: int) -> int:
        """Total number of segment motions whose gradient is taken."""
        steps, batch = self.steps(segments)
        return self.epochs * steps * batch


@eqx.filter_jit
def descend(
    shooting: MultipleShooting, guess: FitVariables, descent: Descent
) -> tuple[FitVariables, Float[Array, " epochs"], Int[Array, ""]]:
    """(end of the descent, mean cost of the steps of each epoch, number of unsound steps).

    In an unsound step some derivatives are nonfinite; these are replaced by 0.
    """
    # Optional dependency: a user of its optimizers has it.
    from optax import with_extra_args_support

    update = with_extra_args_support(descent.optimizer).update
    count = guess.x.shape[0]
    steps, batch = descent.steps(count)
    join = jnp.asarray(descent.gap)

    def step(
        carry: tuple[FitVariables, Any], which: Int[Array, " b"]
    ) -> tuple[Any, tuple[Array, Array]]:
        guess, state = carry

        def value(guess: FitVariables) -> Array:
            return cost_of(guess, shooting, which, join)

        cost, slope = jax.value_and_grad(value)(guess)
        sound = jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in slope]))
        slope = jax.tree.map(lambda x: jnp.where(jnp.isfinite(x), x, 0.0), slope)
        # Optimizers count their steps in integers and mix them with floats.
        with jax.numpy_dtype_promotion("standard"):
            # Line searches need the last three.
            updates, state = update(slope, state, guess, value=cost, grad=slope, value_fn=value)
        z, x = eqx.apply_updates(guess, updates)
        held = jnp.clip(z, shooting.free.low, shooting.free.high)
        return (FitVariables(held, x), state), (cost, ~sound)

    def epoch(carry: tuple[FitVariables, Any], key: Array) -> tuple[Any, tuple[Array, Array]]:
        order = jax.random.permutation(key, count)[: steps * batch]
        carry, (costs, unsound) = jax.lax.scan(step, carry, order.reshape(steps, batch))
        return carry, (jnp.mean(costs), jnp.sum(unsound))

    keys = jax.random.split(jax.random.key(descent.seed), descent.epochs)
    init = guess, descent.optimizer.init(guess)
    (guess, _), (costs, unsound) = jax.lax.scan(epoch, init, keys)
    return guess, costs, jnp.sum(unsound)


def cost_of(
    guess: FitVariables, shooting: MultipleShooting, which: Int[Array, " b"], join: Float[Array, ""]
) -> Float[Array, ""]:
    """Half the sum of squares over all segments, estimated from some of them; plus the priors."""
    segments = jax.tree.map(lambda x: x[which], shooting.segments)
    seen = SegmentOutputs(*jax.vmap(shooting.one, (None, 0, 0))(guess.z, guess.x[which], segments))
    weighed = shooting.weighed(guess.x[which], segments, seen.residuals)
    total = jnp.sum(weighed**2)
    if shooting.chained:
        after = (which + 1) % guess.x.shape[0]
        following = jax.tree.map(lambda x: x[after], shooting.segments)
        begins = jax.vmap(shooting.start)(guess.x[after], following)
        total += jnp.sum(shooting.gaps(segments, seen, begins, join) ** 2)
    share = which.shape[0] / guess.x.shape[0]
    return 0.5 * (total / share + jnp.sum(shooting.known(guess.z) ** 2))
