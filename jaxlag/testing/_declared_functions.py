"""Functions that a system declares, and states, for the check of derivatives."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxlag._core._errors import invalid
from jaxlag._model._constraints import Holonomic, Pfaffian
from jaxlag._model._forces import GeneralizedForce, PointForce, Rayleigh, Torque, reads_lam
from jaxlag._model._input_signals import AbstractInput
from jaxlag._model._inputs import evaluate
from jaxlag._model._quasi_velocities import InQuasiVelocities, Vanishing
from jaxlag._system._system import System
from jaxlag._tracing import _params

STATES = ("given", "rest", "zero", "equal", "one", "random")
_RANDOM = 3  # states of that kind

# Orders of derivatives in the equations of motion, plus one for derivatives of these.
_ENERGY = 2 + 1  # M = d2L/dv2
_HOLONOMIC = 2 + 1  # gamma, the second time derivative
_PFAFFIAN = 1 + 1  # gamma, the first one
_QUASI = 2 + 1  # B', of B = (dU/dv)^-1
_CONJUGATE = 1 + 1  # (dr/dq)^T F, (dw/dv)^T tau, -dR/dv
_FORCE = 0 + 1


class Declared(NamedTuple):
    """A function that the user declared.

    Attributes:
        name: its name in the report.
        function: function of its arguments by name, returning an array of real numbers.
        arguments: its arguments among t, q, v, u, params and lam.
        order: highest order of its derivatives.
    """

    name: str
    function: Callable[[Mapping[str, Any]], Any]
    arguments: tuple[str, ...]
    order: int


class Params:
    """Params as a list of their real leaves, which are differentiated, and the rest."""

    def __init__(self, params: Any) -> None:
        traced, self._static = _params.split(params)
        self._leaves, self._tree = jax.tree.flatten(traced)
        self._real = [i for i, x in enumerate(self._leaves) if jnp.isrealobj(x)]

    @property
    def leaves(self) -> list[Array]:
        """The real ones among the inexact leaves."""
        return [self._leaves[i] for i in self._real]

    def join(self, leaves: Sequence[Any]) -> Any:
        """Params with these in place of `leaves`."""
        given = list(self._leaves)
        for i, leaf in zip(self._real, leaves, strict=True):
            given[i] = leaf
        return _params.join(jax.tree.unflatten(self._tree, given), self._static)


def declared(
    system: System, params: Params, inputs: Mapping[str, AbstractInput | Array]
) -> list[Declared]:
    """The functions of a system, as the user wrote them."""
    found: list[Declared] = []

    def add(name: str, function: Callable, names: str, order: int, driven: bool = False) -> None:
        arguments = tuple(names.split())

        def call(z: Mapping[str, Any]) -> Any:
            whole = params.join(z["params"])
            given = [whole if name == "params" else z[name] for name in arguments]
            if driven:
                values = evaluate(inputs, z["t"], z["q"], z["v"], whole)
                given.insert(4, values)
            return _numbers(function(*given))

        found.append(Declared(name, call, arguments, order))

    speeds = system.written_in
    if system._kinetic is None:
        L = system.lagrangian if system._in_u is None else system._in_u
        add("lagrangian", L, f"t q {speeds} params", _ENERGY)
    else:
        T = system._kinetic
        T = T.function if isinstance(T, InQuasiVelocities) else T
        assert system._potential is not None
        add("kinetic", T, f"t q {speeds} params", _ENERGY)
        add("potential", system._potential, "t q params", _ENERGY)
    for force in system.forces:
        name = f"force {force.name!r}"
        if isinstance(force, GeneralizedForce):
            lam = " lam" if reads_lam(force) else ""
            add(f"{name}: Q", force.Q, "t q v params" + lam, _FORCE, force.takes_inputs)
        elif isinstance(force, PointForce):
            add(f"{name}: position", force.position, "t q params", _CONJUGATE)
            add(f"{name}: force", force.force, "t q v params", _FORCE, force.takes_inputs)
        elif isinstance(force, Torque):
            rate = force.angular_velocity
            add(f"{name}: angular_velocity", rate, "t q v params", _CONJUGATE)
            add(f"{name}: torque", force.torque, "t q v params", _FORCE, force.takes_inputs)
        elif isinstance(force, Rayleigh):
            add(f"{name}: R", force.R, "t q v params", _CONJUGATE)
        else:  # of a class that is not known here: as a whole
            add(name, force, "t q v params", _FORCE, True)
    for row in system.constraints:
        name = f"constraint {row.names!r}"
        if isinstance(row, Holonomic):
            add(f"{name}: phi", row.phi, "t q params", _HOLONOMIC)
        elif isinstance(row, Pfaffian) and not isinstance(row.residual, Vanishing):
            add(f"{name}: residual", row.residual, "t q v params", _PFAFFIAN)
    quasi = system.quasi
    if quasi is not None and quasi.U is not None:
        add("quasi-velocities: U", quasi.U, "t q v params", _QUASI)
    elif quasi is not None and quasi.kinematics is not None:
        add("quasi-velocities: kinematics", quasi.kinematics, "t q u params", _QUASI)
    return found


def _numbers(value: Any) -> Array:
    value = jnp.asarray(value)
    real = jnp.issubdtype(value.dtype, jnp.floating)
    return value if real else value.astype(jnp.result_type(float))


def states(names: Sequence[str], q: Array, v: Array, u: Array | None) -> dict[str, dict]:
    """Name -> q, v and, unless it is None, u, of the distinct states among those requested."""
    if isinstance(names, str) or not names or not set(names) <= set(STATES):
        must, was = f"be names among {list(STATES)}", f"it was {names!r}"
        raise invalid("check_derivatives: states", must, was, 'Write states=("given", "rest").')
    given = {"q": q, "v": v} | ({} if u is None else {"u": u})
    rng = np.random.default_rng(0)

    def each(**change: Callable[[Array], Array]) -> dict:
        return {name: change["q" if name == "q" else "v"](x) for name, x in given.items()}

    def largest(x: Array) -> Array:
        entry = x[jnp.argmax(jnp.abs(x))]
        return jnp.where(entry == 0, jnp.ones_like(entry), entry)

    def equal(x: Array) -> Array:
        return jnp.full_like(x, largest(x))

    def one(x: Array) -> Array:
        return jnp.zeros_like(x).at[0].set(largest(x))

    def near(x: Array) -> Array:
        size = jnp.where(x == 0, 1.0, jnp.abs(x)).astype(x.dtype)
        return x + size * jnp.asarray(rng.uniform(-0.5, 0.5, x.shape), x.dtype)

    all_states = {"given": given}
    all_states["rest"] = each(q=jnp.asarray, v=jnp.zeros_like)
    all_states["zero"] = each(q=jnp.zeros_like, v=jnp.zeros_like)
    all_states["equal"] = each(q=equal, v=equal)
    all_states["one"] = each(q=one, v=one)
    all_states |= {f"random {k + 1}": each(q=near, v=near) for k in range(_RANDOM)}
    distinct: dict[str, dict] = {}
    for name, x in all_states.items():
        met = any(all(np.array_equal(x[k], y[k]) for k in x) for y in distinct.values())
        if name.split()[0] in names and not met:
            distinct[name] = x
    return distinct
