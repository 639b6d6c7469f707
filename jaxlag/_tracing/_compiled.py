"""Compiled functions of params and inputs, cached by the untraced parts of these."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax

from jaxlag._core._xla import QuickJit
from jaxlag._tracing import _params


class Compiled:
    """`jax.jit` of `function(*key, params, inputs, *arrays)`.

    The program is keyed by `key`, a tuple of hashable values, and by the static parts of params and
    inputs. With `batch` axes in front of params, inputs and arrays it is vmapped over these.

    Attributes:
        program: the same for split arguments, `(key, static params, static inputs, batch, traced)`;
            traced are (params, inputs, *arrays).
    """

    def __init__(self, function: Callable) -> None:
        def program(
            key: tuple, params_static: Any, inputs_static: Any, batch: int, traced: Any
        ) -> Any:
            def one(traced: Any) -> Any:
                params, inputs, *arrays = traced
                params = _params.join(params, params_static.tree)
                return function(*key, params, eqx.combine(inputs, inputs_static.tree), *arrays)

            for _ in range(batch):
                one = jax.vmap(one)
            return one(traced)

        program.__name__ = function.__name__
        self.program = QuickJit(program, static_argnums=(0, 1, 2, 3))

    def __call__(self, key: tuple, params: Any, inputs: Any, *arrays: Any, batch: int = 0) -> Any:
        params, params_static = _params.split(params)
        inputs, inputs_static = _params.arrays_apart(inputs)
        static = _params.Static(params_static), _params.Static(inputs_static)
        return self.program(key, *static, batch, (params, inputs, *arrays))
