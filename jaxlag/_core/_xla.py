"""XLA settings by which the CPU backend compiles a loop to one native function.

Before jax 0.12 XLA runs the body of a while loop operation by operation unless the loop handles
less than about a kilobyte. The dispatch then costs ten times the arithmetic of a small mechanical
system. There are two ways to raise that bound:

* the global setting, which XLA reads once, before the first compilation;
* if that came too late or is switched off, attributes on the call of a function that holds the
  loop. They are internal to XLA. They are used only on the versions that the tests run on, and
  only around operations that XLA emits code for itself. A call need not be one of a loop
  (`_native_call`).

A second global setting is for LLVM: how many pairs of arrays a loop may compare for overlap before
it runs vectorized. A loop over lanes with many results has hundreds. LLVM ends the process at an
option that it does not know: it is set only on the versions that the tests run on.
"""

import os
import warnings
from collections.abc import Callable, Sequence
from functools import lru_cache, partial, update_wrapper
from typing import Any

import jax
import jax.numpy as jnp
import jaxlib
import numpy as np
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend.core import ClosedJaxpr, Jaxpr, find_top_trace, jaxpr_as_fun

from jaxlag._core._jaxprs import equations

OPTION = "xla_cpu_small_while_loop_byte_threshold"
BYTES = 10_000_000
SWITCH = "JAXLAG_XLA_FLAGS"
ATTRIBUTE_SWITCH = "JAXLAG_XLA_ATTRIBUTES"
ATTRIBUTES = {"xla_cpu_small_call": "true", "inlineable": "false"}
ATTRIBUTES_TESTED = ("0.10.2", "0.12.0.1")  # versions of jaxlib
TESTED = ("0.10.2",)  # versions of jaxlib with the options of `QuickJit`
COMPARISONS = "-vectorize-memory-check-threshold=4000"
COMPARISONS_TESTED = ("0.10.2", "0.12.0.1")  # versions of jaxlib
EXTRA = "--xla_backend_extra_options="


def needed() -> bool:
    """Whether this jax keeps the old bound; 0.12 raised it itself."""
    return tuple(int(part) for part in jax.__version__.split(".")[:2]) < (0, 12)


def merged(flags: str) -> str:
    """XLA_FLAGS with the settings added to the extra backend options.

    A bound set by the user is kept.
    """
    if OPTION in flags:
        return flags
    options = [f"{OPTION}={BYTES}"]
    if jaxlib.__version__ in COMPARISONS_TESTED:
        options.append(COMPARISONS)
    words = flags.split()
    for i, word in enumerate(words):
        if word.startswith(EXTRA):
            present = word.removeprefix(EXTRA)
            words[i] = EXTRA + ",".join([present, *options] if present else options)
            return " ".join(words)
    return " ".join([*words, EXTRA + ",".join(options)])


def configure() -> None:
    """Set both, unless JAXLAG_XLA_FLAGS=0 or jax has raised the bound itself and is not tested."""
    wanted = needed() or jaxlib.__version__ in COMPARISONS_TESTED
    if wanted and os.environ.get(SWITCH) != "0":
        os.environ["XLA_FLAGS"] = merged(os.environ.get("XLA_FLAGS", ""))


@lru_cache(maxsize=1)
def in_force() -> bool:
    """Whether loops beyond the old bound compile to one function, tested by a compilation."""
    return _is_native(1000)


@lru_cache(maxsize=1)
def vectorizes() -> bool:
    """Whether loops over lanes with many results are vectorized, tested by compilations.

    XLA reads both settings at once. Later versions take larger loops without them.
    """
    if jax.default_backend() != "cpu" or jaxlib.__version__ not in COMPARISONS_TESTED:
        return False
    is_set = f"{OPTION}={BYTES},{COMPARISONS}" in os.environ.get("XLA_FLAGS", "")
    return is_set and in_force() and not _is_native(BYTES)


def _is_native(size: int) -> bool:
    """Whether a loop over an array of this size compiles to one function."""

    def loop(x: jax.Array) -> jax.Array:
        body_fun = lambda c: (c[0] + 1, c[1] * c[1][::-1])  # noqa: E731
        return jax.lax.while_loop(lambda c: c[0] < 3, body_fun, (0, x))[1]

    compiled = jax.jit(loop).lower(jax.ShapeDtypeStruct((size,), jnp.float32)).compile()
    return "small_call" in (compiled.as_text() or "")


def may_mark() -> bool:
    """Whether attributes of a call may compile it to one function."""
    return (
        jax.default_backend() == "cpu"
        and os.environ.get(ATTRIBUTE_SWITCH) != "0"
        and jaxlib.__version__ in ATTRIBUTES_TESTED
    )


def by_attribute() -> bool:
    """Whether loops beyond the bound compile to one function by attributes of their calls."""
    return may_mark() and not in_force()


def native(function: Callable, *args: Any, stages: int = 0) -> Any:
    """function(*args), a loop, compiled to one native function if XLA allows it.

    Args:
        function: of arrays and pytrees of them, without side effects.
        args: its arguments.
        stages: of a method whose weighted sums of stages are products with a vector.
    """
    if not by_attribute():
        return function(*args)
    flat, tree = jax.tree.flatten(args)
    program, shape = jax.make_jaxpr(
        lambda *flat: function(*jax.tree.unflatten(tree, flat)), return_shape=True
    )(*flat)
    if not is_plain(program.jaxpr, stages):
        return function(*args)

    def run(*given: Any) -> list:
        consts, flat = given[: len(program.consts)], given[len(program.consts) :]
        return jaxpr_as_fun(ClosedJaxpr(program.jaxpr, consts))(*flat)

    results = marked(run, (*program.consts, *flat))
    return jax.tree.unflatten(jax.tree.structure(shape), results)


def marked(function: Callable, args: Sequence[Any]) -> list:
    """function(*args), compiled to one native function: both are plain.

    A parameter without uses inside, because it is constant or has no effect, crashes the process:
    the emitter of marked calls searches for a missing buffer. So none is constant, and a sum of
    numbers of all is returned.
    """
    given = jax.lax.optimization_barrier(list(map(jnp.asarray, args)))

    def run(*given: Any) -> Any:
        used = [x.reshape(-1)[0].real.astype(jnp.float32) for x in given if x.size]
        return function(*given), sum(used), [x for x in given if not x.size]

    return not_inlined(run, ATTRIBUTES)(*given)[0]


# XLA's emitters of fusions take half of the compile time of a program of many small operations:
# they run a pipeline of passes for each fusion. The arithmetic is the same without them. An option
# that XLA does not know is an error.
_OPTIONS = {"xla_cpu_use_fusion_emitters": False}


class QuickJit:
    """`jax.jit` with options that shorten compilation, where JAX takes options.

    It takes them only outside of all transforms; they are used on the versions of jaxlib that the
    tests run on.

    Args:
        function: to be compiled.
        static_argnums: as for `jax.jit`.
        inside: the same function in another form, used inside transforms.
    """

    def __init__(
        self, function: Callable, static_argnums: Any = (), inside: Callable | None = None
    ) -> None:
        jit = partial(jax.jit, static_argnums=static_argnums)
        self._inside: Any = jit(inside or function)
        self._alone: Any = None if inside is None else jit(function)
        update_wrapper(self, function)
        if jaxlib.__version__ in TESTED:
            self._alone = jit(function, compiler_options=_OPTIONS)

    def __call__(self, *args: Any) -> Any:
        """The results of the function."""
        return self._program(*args)

    @property
    def _program(self) -> Any:
        eager = type(find_top_trace(())).__name__ == "EvalTrace"
        return self._alone if eager and self._alone is not None and _on_cpu() else self._inside

    def programs(self) -> int:
        """Number of programs compiled."""
        return sum(jit._cache_size() for jit in (self._inside, self._alone) if jit is not None)


def _on_cpu() -> bool:
    return jax.default_backend() == "cpu"


def not_inlined(function: Callable, attributes: Any = None) -> Callable:
    """The function, compiled separately from its callers."""
    attributes = attributes or {"inlineable": "false"}

    def body(*args: Any) -> Any:
        # The attributes belong to the call, not to the function body.
        with set_xla_metadata(**dict.fromkeys(attributes)):
            return function(*args)

    compiled = jax.jit(body)

    def call(*args: Any) -> Any:
        with set_xla_metadata(**attributes):
            return compiled(*args)

    return call


def opaque_one(dtype: Any) -> jax.Array:
    """1, as a value that XLA cannot fold: a division by it is computed once.

    XLA recomputes cheap operations, all but divisions, roots and the like, for every
    use.
    """
    return jax.lax.optimization_barrier(jnp.ones((), dtype))


def is_plain(jaxpr: Jaxpr, stages: int = 0) -> bool:
    """Whether a program contains only plain operations."""
    return all(is_plain_operation(eqn, stages) for eqn in equations(jaxpr))


def is_plain_operation(eqn: Any, stages: int = 0) -> bool:
    """Whether an operation is one on numbers that XLA itself emits code for.

    Sums of more than some thousand numbers call a library.
    """
    name = eqn.primitive.name
    if name in _REDUCTIONS:
        return eqn.invars[0].aval.size <= SUMMED
    return _is_sum(eqn, stages) if name == "dot_general" else name in _PLAIN


def _is_sum(dot: Any, stages: int) -> bool:
    """Whether a product is one of numbers, or of a row of a method's weights with its stages.

    Products of matrices call a library, and a vmap turns any other product into one.
    """
    contracted, batched = dot.params["dimension_numbers"]
    operand = dot.invars[0].aval
    if np.prod([operand.shape[i] for i in contracted[0]]) <= 1:
        return True
    rows = [x.aval.size for x in dot.invars if x.aval.ndim == 1]
    return not any(batched) and any(size in (stages - 1, stages) for size in rows)


SUMMED = 1024
_REDUCTIONS = frozenset(("reduce_sum", "reduce_prod", "reduce_max", "reduce_min"))
_PLAIN = _REDUCTIONS | frozenset(
    """abs acos acosh add add_any and asin asinh atan atan2 atanh bitcast_convert_type
    broadcast_in_dim cbrt ceil checkpoint clamp closed_call concatenate cond
    convert_element_type copy copy_p cos cosh cummax cumsum custom_jvp_call custom_vjp_call
    custom_vmap_call div dynamic_slice dynamic_update_slice empty2 eq erf exp exp2 expand_dims
    expm1 floor gather ge gt integer_pow iota is_finite jit largest le le_to linear_map log log1p
    logistic lt lt_to max maybe_set min mul ne neg nextafter nonbatchable nondifferentiable not
    one_minus_square optimization_barrier or pad pjit platform_index polynomial pow reduce_and
    reduce_or rem remat remat2 reshape rev round
    rsqrt scan
    select_and_gather_add select_n shift_left sign sin sinh
    slice smallest split sqrt square squeeze stack stop_gradient sub symbolic_zeros tan tanh
    transpose unstack unvmap_all unvmap_any unvmap_max while xor""".split()  # noqa: SIM905
)


# On numbers XLA emits code for these that LLVM vectorizes, or calls of functions within it. For erf
# it emits a call that prevents both.
ELEMENTWISE = frozenset(
    """abs acos acosh add and asin asinh atan atan2 atanh bitcast_convert_type cbrt ceil clamp
    convert_element_type copy copy_p cos cosh div eq erfc exp exp2 expm1 floor ge gt integer_pow
    is_finite largest le log log1p logistic lt max min mul ne neg nextafter not or pow rem round
    rsqrt select_n shift_left shift_right_arithmetic shift_right_logical sign sin sinh smallest sqrt
    square stop_gradient sub tan tanh xor""".split()  # noqa: SIM905
)


_DISPATCH = "jax_cpu_enable_async_dispatch=False saves up to 40 us in each call of JAX"


def report() -> str:
    """One line for `System.explain`."""
    if jax.default_backend() != "cpu":
        return f"the CPU setting does not apply on {jax.default_backend()}"
    hands_over = jax.config.read("jax_cpu_enable_async_dispatch")
    return _loops() + (f"; {_DISPATCH}" if hands_over else "")


def _loops() -> str:
    if in_force():
        return "solver loops compile to one native function"
    if by_attribute():
        return "solver loops compile to one native function, by attributes of their calls"
    if os.environ.get(SWITCH) == "0":
        other = f" and {ATTRIBUTE_SWITCH}=0" if os.environ.get(ATTRIBUTE_SWITCH) == "0" else ""
        return f"run operation by operation: {SWITCH}=0{other}"
    return "run operation by operation: " + _LATE


_LATE = (
    "XLA had compiled something before jaxlag was imported, so its loop setting came too late. "
    "Import jaxlag before the first jax computation."
)


@lru_cache(maxsize=1)
def warn_if_late() -> None:
    """Warn once per process if the setting came too late."""
    if jax.default_backend() != "cpu" or not needed() or os.environ.get(SWITCH) == "0":
        return
    if not in_force() and not by_attribute():
        warnings.warn(f"Solves will be several times slower: {_LATE}", stacklevel=4)
