"""Functions that a system declares, by name and by their role in the equations of motion."""

from collections.abc import Callable, Mapping, Sequence
from enum import Enum
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxlag._model._constraints import Holonomic, Pfaffian
from jaxlag._model._forces import GeneralizedForce, PointForce, Rayleigh, Torque, reads_lam
from jaxlag._model._input_signals import AbstractInput
from jaxlag._model._inputs import evaluate
from jaxlag._model._quasi_velocities import InQuasiVelocities, Vanishing
from jaxlag._model._states import with_states
from jaxlag._system._state_functions import AbstractQuantities
from jaxlag._tracing import _params


class Role(Enum):
    """How the equations of motion use a declared function; the value tells its roles apart."""

    energy = "L or T: the function, M = d2L/dv2, dp/dq v + dp/dt - dL/dq"
    potential = "V: dV/dq"
    holonomic = "phi: A = dphi/dq and the second time derivative"
    pfaffian = "residual: A = dr/dv and the first time derivative"
    quasi = "U or kinematics: dU/dv and its time derivative"
    conjugate = "(dr/dq)^T F, (dw/dv)^T tau, -dR/dv"
    force = "the function alone"

    @property
    def order(self) -> int:
        """Highest order of the derivatives in the equations of motion."""
        return _ORDERS[self]


_ORDERS = {
    Role.energy: 2,
    Role.potential: 2,
    Role.holonomic: 2,
    Role.pfaffian: 1,
    Role.quasi: 2,
    Role.conjugate: 1,
    Role.force: 0,
}


class Declared(NamedTuple):
    """A function that the user declared.

    Attributes:
        name: its name in the report.
        function: function of its arguments by name, returning an array of real numbers.
        arguments: its arguments among t, q, v, u, params, lam and x, that of `States`.
        role: its role in the equations of motion.
    """

    name: str
    function: Callable[[Mapping[str, Any]], Any]
    arguments: tuple[str, ...]
    role: Role


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
    system: AbstractQuantities, params: Params, inputs: Mapping[str, AbstractInput | Array]
) -> list[Declared]:
    """The functions of a system, as the user wrote them."""
    found: list[Declared] = []

    def add(name: str, function: Callable, names: str, role: Role, driven: bool = False) -> None:
        arguments = tuple(names.split())
        beside = ("x",) if driven and system.states is not None else ()

        def call(z: Mapping[str, Any]) -> Any:
            whole = params.join(z["params"])
            given = [whole if name == "params" else z[name] for name in arguments]
            if driven:
                values = evaluate(inputs, z["t"], z["q"], z["v"], whole)
                given.insert(4, with_states(values, system.states, z["x"]) if beside else values)
            return _numbers(function(*given))

        found.append(Declared(name, call, (*arguments, *beside), role))

    speeds = "v" if system._in_u is None else "u"
    if system._kinetic is None:
        L = system.lagrangian if system._in_u is None else system._in_u
        add("lagrangian", L, f"t q {speeds} params", Role.energy)
    else:
        T = system._kinetic
        T = T.function if isinstance(T, InQuasiVelocities) else T
        assert system._potential is not None
        add("kinetic", T, f"t q {speeds} params", Role.energy)
        add("potential", system._potential, "t q params", Role.potential)
    for force in system.forces:
        name = f"force {force.name!r}"
        if isinstance(force, GeneralizedForce):
            lam = " lam" if reads_lam(force) else ""
            add(f"{name}: Q", force.Q, "t q v params" + lam, Role.force, force.takes_inputs)
        elif isinstance(force, PointForce):
            add(f"{name}: position", force.position, "t q params", Role.conjugate)
            add(f"{name}: force", force.force, "t q v params", Role.force, force.takes_inputs)
        elif isinstance(force, Torque):
            rate = force.angular_velocity
            add(f"{name}: angular_velocity", rate, "t q v params", Role.conjugate)
            add(f"{name}: torque", force.torque, "t q v params", Role.force, force.takes_inputs)
        elif isinstance(force, Rayleigh):
            add(f"{name}: R", force.R, "t q v params", Role.conjugate)
        else:  # of a class that is not known here: as a whole
            add(name, force, "t q v params", Role.force, True)
    if system.states is not None:
        add("states: rate", system.states.rates, "t q v params", Role.force, True)
    for row in system.constraints:
        name = f"constraint {row.names!r}"
        if isinstance(row, Holonomic):
            add(f"{name}: phi", row.phi, "t q params", Role.holonomic)
        elif isinstance(row, Pfaffian) and not isinstance(row.residual, Vanishing):
            add(f"{name}: residual", row.residual, "t q v params", Role.pfaffian)
    quasi = system.quasi
    if quasi is not None and quasi.U is not None:
        add("quasi-velocities: U", quasi.U, "t q v params", Role.quasi)
    elif quasi is not None and quasi.kinematics is not None:
        add("quasi-velocities: kinematics", quasi.kinematics, "t q u params", Role.quasi)
    return found


def _numbers(value: Any) -> Array:
    value = jnp.asarray(value)
    real = jnp.issubdtype(value.dtype, jnp.floating)
    return value if real else value.astype(jnp.result_type(float))
