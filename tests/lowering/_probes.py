"""Expressions that a user may write in a Lagrangian: each a scalar function of x, shape (3,)."""

import jax
import jax.numpy as jnp
from jax import lax

from jaxlag import math

WEIGHTS = jnp.array([0.7, -1.3, 0.4])
MATRIX = jnp.array([[2.0, 0.3, -0.1], [0.3, 1.5, 0.2], [-0.1, 0.2, 1.1]])
TWO = jnp.stack([MATRIX, MATRIX.T])


@jax.custom_jvp
def doubled(x):
    return jnp.sin(x)


@doubled.defjvp
def _(primals, tangents):
    """Twice the true derivative, to distinguish the rule from the primal."""
    (x,), (dx,) = primals, tangents
    return doubled(x), 2.0 * jnp.cos(x) * dx


@jax.custom_jvp
def turned(a, b):
    return a * b, a + b


@turned.defjvp
def _(primals, tangents):
    a, b = primals
    da, db = tangents
    return turned(a, b), (3.0 * b * da + a * db, da - db)


def unrolled_scan(x):
    def body(carry, entry):
        return carry * jnp.cos(entry) + entry, carry * entry

    last, entries = lax.scan(body, x[0], x)
    return last + entries @ WEIGHTS


def reversed_scan(x):
    return lax.scan(lambda c, r: (c * r + 1.0, c), 0.5, x, reverse=True)[1] @ WEIGHTS


def branches(x):
    return lax.cond(x[0] > 0.2, lambda x: jnp.sin(x[1]), lambda x: x[1] ** 2 * x[2], x)


def switched(x):
    which = (x[0] > 0.2).astype(jnp.int32) + (x[1] > 0.0).astype(jnp.int32)
    return lax.switch(which, [jnp.sum, lambda x: x @ x, lambda x: jnp.cos(x[0])], x)


PROBES = {
    "product": lambda x: x[0] * x[1] * x[2],
    "quotient": lambda x: x[0] / (1.5 + x[1] ** 2),
    "powers": lambda x: x[0] ** 3 - 2.0 * x[1] ** 2 + x[2] ** -2,
    "negative base": lambda x: (-1.0 - x[0] ** 2) ** 3,
    "real power": lambda x: (2.0 + x[0]) ** 2.5 + (2.0 + x[1]) ** 0.5,
    "power of a power": lambda x: ((1.0 + x[0] ** 2) ** 3) ** -2,
    "exponent x": lambda x: (2.0 + x[0]) ** x[1],
    "square": lambda x: jnp.square(x[0] - x[1]),
    "sqrt": lambda x: jnp.sqrt(2.0 + x[0]) * jnp.sqrt(2.0 + x[0]) + jnp.sqrt(3.0 + x[1] * x[2]),
    "rsqrt": lambda x: lax.rsqrt(2.0 + x[0]),
    "cbrt": lambda x: jnp.cbrt(2.0 + x[0]),
    "sqrt of a square": lambda x: jnp.sqrt(x[0] ** 2) * x[1],
    "abs": lambda x: jnp.abs(x[0]) * x[1] + jnp.abs(-x[1]),
    "sign": lambda x: jnp.sign(x[0]) * x[1],
    "sin and cos": lambda x: jnp.sin(x[0]) ** 2 + jnp.cos(x[0]) ** 2 + jnp.sin(-x[1]),
    "tan": lambda x: jnp.tan(x[0]),
    "arcs": lambda x: jnp.arcsin(0.3 * x[0]) + jnp.arccos(0.3 * x[1]) + jnp.arctan(x[2]),
    "arctan2": lambda x: jnp.arctan2(x[0], x[1]),
    "hyperbolic": lambda x: jnp.sinh(x[0]) + jnp.cosh(x[1]) + jnp.tanh(x[2]),
    "inverse hyperbolic": lambda x: jnp.arcsinh(x[0]) + jnp.arccosh(2.0 + x[1] ** 2),
    "arctanh": lambda x: jnp.arctanh(0.2 * x[2]),
    "exponentials": lambda x: jnp.exp(x[0]) + jnp.exp2(x[1]) + jnp.expm1(x[2]),
    "logarithms": lambda x: jnp.log(2.0 + x[0]) + jnp.log1p(x[1] ** 2) + jnp.log10(3.0 + x[2]),
    "sigmoid": lambda x: jax.nn.sigmoid(x[0]) + jax.nn.silu(x[1]),
    "erf": lambda x: jax.scipy.special.erf(x[0]) + jax.scipy.special.erfc(x[1]),
    "bessel": lambda x: jax.scipy.special.i0e(x[0]),
    "gamma": lambda x: jax.scipy.special.gammaln(2.5 + x[0]),
    "maximum": lambda x: jnp.maximum(x[0], x[1]) * jnp.minimum(x[1], 2.0 * x[2]),
    "clip": lambda x: jnp.clip(x[0], -0.5, 0.5) * x[1],
    "floor": lambda x: jnp.floor(x[0]) * x[1] + jnp.round(x[1]) * x[2] + jnp.ceil(x[2]),
    "remainder": lambda x: jnp.mod(x[0], 0.7) * x[1],
    "where": lambda x: jnp.where(x[0] > x[1], x[0] * x[2], x[1] ** 2),
    "safe where": lambda x: jnp.where(x[0] > 0, jnp.sqrt(jnp.where(x[0] > 0, x[0], 1.0)), 0.0),
    "logical": lambda x: jnp.where((x[0] > 0) & ~(x[1] > 0) | (x[2] != x[2]), x[0], x[1]),
    "select by number": lambda x: jnp.select([x[0] > 0.5, x[1] > 0.0], [x[0], x[1] * x[2]], x[2]),
    "heaviside": lambda x: jnp.heaviside(x[0], 0.5) * x[1],
    "piecewise": lambda x: jnp.piecewise(x[0], [x[0] < 0.0, x[0] >= 0.0], [jnp.sin, jnp.cos]),
    "dot": lambda x: x @ MATRIX @ x,
    "einsum": lambda x: jnp.einsum("i,ij,j->", x, MATRIX, jnp.sin(x)),
    "batched product": lambda x: jnp.sum(jnp.einsum("ki,kij->kj", jnp.stack([x, 2 * x]), TWO)),
    "outer": lambda x: jnp.sum(jnp.outer(x, jnp.sin(x)) * MATRIX),
    "cross": lambda x: jnp.cross(x, WEIGHTS) @ jnp.cos(x),
    "trace": lambda x: jnp.trace(jnp.outer(x, x) @ MATRIX),
    "norm": lambda x: jnp.linalg.norm(x - WEIGHTS),
    "determinant by hand": lambda x: jnp.dot(x, jnp.cross(MATRIX[0], MATRIX[1] * x)),
    "sums": lambda x: jnp.sum(x) + jnp.prod(x) + jnp.mean(x**2) + jnp.var(x),
    "extremes": lambda x: jnp.max(x) * jnp.min(x),
    "cumsum": lambda x: jnp.cumsum(x) @ jnp.sin(jnp.cumsum(x[::-1])),
    "cumprod": lambda x: jnp.cumprod(x) @ WEIGHTS,
    "cummax": lambda x: lax.cummax(x) @ WEIGHTS,
    "any and all": lambda x: jnp.where(jnp.any(x > 1.0) | jnp.all(x < 0.5), x[0], x[1]),
    "slices": lambda x: x[1:] @ x[:-1] + x[-1],
    "strides": lambda x: jnp.sum(x[::2]) * x[1],
    "gather": lambda x: x[jnp.array([2, 0, 0])] @ WEIGHTS,
    "gather past the end": lambda x: x.at[jnp.array([1, 2])].get(mode="clip") @ WEIGHTS[:2],
    "take along": lambda x: jnp.sum(jnp.take_along_axis(x, jnp.array([1, 1]), axis=0)) * x[0],
    "set": lambda x: x.at[1].set(x[0] * x[2]) @ WEIGHTS,
    "add at": lambda x: x.at[jnp.array([0, 0, 2])].add(jnp.sin(x)) @ WEIGHTS,
    "multiply at": lambda x: x.at[1].multiply(x[0]) @ WEIGHTS,
    "concatenate": lambda x: jnp.concatenate([x, jnp.sin(x)]) @ jnp.arange(6.0),
    "stack": lambda x: jnp.sum(jnp.stack([x, x**2], axis=1) * jnp.arange(6.0).reshape(3, 2)),
    "pad": lambda x: jnp.pad(x, (1, 2), constant_values=0.5) @ jnp.arange(6.0),
    "roll": lambda x: jnp.roll(x, 1) @ x,
    "transpose": lambda x: jnp.sum(jnp.outer(x, x**2).T * MATRIX),
    "tile and repeat": lambda x: jnp.tile(x, 2) @ jnp.repeat(x, 2),
    "reshape": lambda x: jnp.outer(x, x).reshape(-1)[4] + jnp.ravel(jnp.outer(x, x))[2],
    "flip": lambda x: jnp.flip(x) @ WEIGHTS,
    "diagonal": lambda x: jnp.diag(x) @ MATRIX[0] @ x,
    "triangle": lambda x: jnp.sum(jnp.tril(jnp.outer(x, x))),
    "kron": lambda x: jnp.sum(jnp.kron(x, WEIGHTS) ** 2),
    "polynomial": lambda x: jnp.polyval(WEIGHTS, x[0]),
    "vmap": lambda x: jnp.sum(jax.vmap(lambda a: a * jnp.sin(a))(x)),
    "jvp inside": lambda x: jax.jvp(jnp.sin, (x[0],), (x[1],))[1],
    "gradient inside": lambda x: jax.grad(lambda y: jnp.sum(y**3))(x) @ WEIGHTS,
    "jit inside": lambda x: jax.jit(jnp.sum)(x) * x[0],
    "checkpoint": lambda x: jax.checkpoint(lambda y: jnp.sin(y[0]) * y[1])(x),
    "scan": unrolled_scan,
    "scan backwards": reversed_scan,
    "fori": lambda x: lax.fori_loop(0, 3, lambda i, c: c * x[i] + 1.0, 0.5),
    "cond": branches,
    "switch": switched,
    "cond known": lambda x: lax.cond(True, jnp.sum, jnp.prod, x),
    "custom rule": lambda x: doubled(x[0]) * x[1],
    "custom rule of two": lambda x: turned(x[0], x[1])[0] * turned(x[0], x[1])[1],
    "stopped": lambda x: lax.stop_gradient(x[0]) * x[0] * x[1],
    "stopped whole": lambda x: lax.stop_gradient(jnp.sin(x)) @ x,
    "relu": lambda x: jax.nn.relu(x[0]) * x[1] + jax.nn.softplus(x[2]),
    "gelu": lambda x: jax.nn.gelu(x[0]) + jax.nn.leaky_relu(x[1]),
    "softmax": lambda x: jax.nn.softmax(x) @ WEIGHTS + jax.nn.logsumexp(x),
    "safe norm": lambda x: math.norm(x - WEIGHTS) + math.sinc(x[0]),
    "safe angle": lambda x: math.angle_between(x, WEIGHTS) + math.one_minus_cos(x[1]),
    "sinc": lambda x: jnp.sinc(x[0]),
    "interpolation by hand": lambda x: jnp.sum(jnp.where(x > 0, x, 0.1 * x) * WEIGHTS),
    "constant": lambda x: jnp.sum(WEIGHTS) + 0.0 * x[0],
}  # fmt: skip

# Functions without a scalar form, and the primitive that the reason names.
FALLBACKS = {
    "sort": (lambda x: jnp.sort(x) @ WEIGHTS, "sort"),
    "index by argmax": (lambda x: x[jnp.argmax(x)], "index that depends on values"),
    "solve": (lambda x: jnp.linalg.solve(MATRIX + jnp.diag(x), x)[0], "lu"),
    "inverse": (lambda x: jnp.linalg.inv(MATRIX + jnp.diag(x))[0, 0], "lu"),
    "cholesky": (lambda x: jnp.linalg.cholesky(MATRIX + jnp.diag(x**2))[2, 2], "cholesky"),
    "eigenvalues": (lambda x: jnp.linalg.eigvalsh(MATRIX + jnp.diag(x))[0], "eigh"),
    "interp": (lambda x: jnp.interp(x[0], jnp.arange(4.0), jnp.arange(4.0) ** 2), ""),
    "index of the state": (lambda x: x[jnp.floor(jnp.abs(x[0])).astype(int)], "conversion"),
    "open loop": (lambda x: lax.while_loop(lambda c: c < 2, lambda c: 2 * c, x[0] ** 2), "while"),
    "single precision": (lambda x: jnp.sum(x.astype(jnp.float32)).astype(float), "conversion"),
    "transform": (lambda x: jnp.abs(jnp.fft.fft(x))[0], "complex"),
    "callback": (lambda x: jax.pure_callback(jnp.sin, x, x)[0], "pure_callback"),
}  # fmt: skip
