"""The equations of motion around one state, as functions of its deviations."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlag._analysis._outputs import Outputs, Values
from jaxlag._lowering import State
from jaxlag._model._coordinates import Coordinates
from jaxlag._model._forces import reads_lam
from jaxlag._model._input_signals import Feedback
from jaxlag._model._inputs import evaluate
from jaxlag._model._states import named_states, state_names, with_states
from jaxlag._system._system import System
from jaxlag._tracing import _params


class Scene(NamedTuple):
    """What is linearized; hashable.

    Attributes:
        system: the mechanical system.
        sample: params for checks of the code.
        outputs: the declared outputs.
        opened: names of the inputs that are varied.
    """

    system: System
    sample: _params.Sample
    outputs: Outputs
    opened: tuple[str, ...]


def scene_of(
    system: System, sample: _params.Sample, outputs: Outputs, signals: Mapping[str, Any]
) -> Scene:
    """The scene; inputs by `Feedback` and states of the system are not varied as inputs."""
    own = state_names(system.states)
    opened = [name for name, x in signals.items() if not isinstance(x, Feedback)]
    return Scene(system, sample, outputs, tuple(name for name in opened if name not in own))


class Point(NamedTuple):
    """What declared functions read.

    Attributes:
        q: coordinates.
        w: velocities, or the free quasi-velocities.
        v: velocities.
        x: states of the system.
        values: of the inputs, with these.
    """

    q: Float[Array, " n"]
    w: Float[Array, " k"]
    v: Float[Array, " n"]
    x: Float[Array, " s"]
    values: Any


class Equations(NamedTuple):
    """The equations around one state, as functions of z = (q, w, x, inputs).

    w are the velocities, or the free quasi-velocities.

    Attributes:
        scene: what is linearized.
        params: as the Lagrangian takes them.
        feedback: the inputs by `Feedback`.
        opened: values of the other inputs at the state.
        t: time.
        z: of the state.
    """

    scene: Scene
    params: Any
    feedback: Mapping[str, Any]
    opened: Mapping[str, Array]
    t: Float[Array, ""]
    z: Float[Array, " m"]

    @property
    def size(self) -> int:
        """Length of (q, w, x)."""
        return self.z.shape[0] - sum(jnp.size(x) for x in self.opened.values())

    @property
    def speeds(self) -> int:
        """Length of w."""
        system = self.scene.system
        return system.size if system.quasi is None else len(system.quasi.free)

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of the entries of the inputs."""
        shapes = {name: jnp.shape(x) for name, x in self.opened.items()}
        return Coordinates(shapes, "linearize: inputs").labels if shapes else ()

    @property
    def places(self) -> dict[str, list[tuple[int, ...]]]:
        """Names of the entries of z, and the places of every quantity of this name.

        Those of arrays have all of their entries.
        """
        system, found = self.scene.system, {}
        coordinates, end = system.coordinates, 0
        velocities = {f"{name}'": places for name, places in coordinates.places.items()}
        parts = [(coordinates.labels, coordinates.places)]
        if system.quasi is None:
            parts.append((tuple(f"{x}'" for x in coordinates.labels), velocities))
        else:
            parts.append((tuple(system.quasi.names[i] for i in system.quasi.free), {}))
        if system.states is not None:
            parts.append((system.states.layout.labels, system.states.layout.places))
        if self.opened:
            shapes = {name: jnp.shape(x) for name, x in self.opened.items()}
            inputs = Coordinates(shapes, "linearize: inputs")
            parts.append((inputs.labels, inputs.places))
        for labels, names in parts:
            every = {label: (i,) for i, label in enumerate(labels)} | dict(names)
            for name, entries in every.items():
                found.setdefault(name, []).append(tuple(end + i for i in entries))
            end += len(labels)
        return found

    def directions(self, basis: Float[Array, "s k"]) -> Float[Array, "m j"]:
        """Those of the states, then those of the inputs."""
        inputs = jnp.eye(self.z.shape[0] - self.size, dtype=basis.dtype)
        return jax.scipy.linalg.block_diag(basis, inputs)

    def point(self, z: Float[Array, " m"]) -> Point:
        """The state and the values of all inputs."""
        system, t, params = self.scene.system, self.t, self.params
        n, k = system.size, self.speeds
        sizes = [jnp.size(x) for x in self.opened.values()]
        ends = np.cumsum([n, k, self.size - n - k, *sizes])[:-1]
        q, w, x, *parts = jnp.split(z, ends)
        pairs = zip(self.opened.items(), parts, strict=True)
        opened = {name: part.reshape(jnp.shape(value)) for (name, value), part in pairs}
        v = w
        if system.quasi is not None:
            v = system.quasi.velocities(t, q, system.quasi.full(w), params)
        values = evaluate({**self.feedback, **opened}, t, q, v, params)
        return Point(q, w, v, x, with_states(values, system.states, x))

    def given(self, z: Float[Array, " m"]) -> dict[str, Array]:
        """Values of the inputs that are varied and of the states of the system, by name."""
        values, end = {}, self.size
        for name, value in self.opened.items():
            size = jnp.size(value)
            values[name] = z[end : end + size].reshape(jnp.shape(value))
            end += size
        return values | named_states(self.scene.system.states, self.point(z).x)

    def rates(self, z: Float[Array, " m"]) -> tuple[Array, Array]:
        """(rates of (q, w, x), outputs)."""
        scene, t, params = self.scene, self.t, self.params
        system, at = scene.system, self.point(z)
        a, lam = self._accelerations(at)
        found, u = [at.v, a], jnp.zeros((0,), z.dtype)
        if system.states is not None:
            found.append(system.states.rates_at(t, at.q, at.v, at.x, params, at.values))
        if system.quasi is not None:
            u = system.quasi.full(at.w)
        outputs = scene.outputs.of(Values(at.q, at.v, u, at.x, lam), t, params)
        return jnp.concatenate(found), outputs

    def multipliers(self) -> Float[Array, " m"]:
        """Those of the state that forces read; of length m = 0 if none are read."""
        at, system = self.point(self.z), self.scene.system
        if not any(map(reads_lam, system.forces)):
            return jnp.zeros((0,), at.q.dtype)
        state = State(self.t, at.q, at.v, self.params, at.values)
        return system._program.reactions(state, self.scene.sample)[1]

    def _accelerations(self, at: Point) -> tuple[Array, Array]:
        """(w', lam)."""
        system, sample, outputs, _ = self.scene
        state = State(self.t, at.q, at.w, self.params, at.values)
        none = jnp.zeros((0,), at.q.dtype)
        if system.quasi is None:
            if system.constraints:
                return system._program.reactions(state, sample)[:2]
            return system._program.acceleration(state), none
        if outputs.reads("lam") or any(map(reads_lam, system.forces)):
            # Equations in quasi-velocities have no multipliers.
            a, lam, _ = system._program.reactions(state._replace(w=at.v), sample)
            return self._quasi_rates(at.q, at.v, a), lam
        terms = replace(system._terms, quasi=system.quasi, in_u=system._in_u)
        program = replace(system._program, array=terms)
        constants = program.precompute(at.q, self.params, at.values)
        return program.quasi_rates(state, constants)[system.size :], none

    def _quasi_rates(self, q: Array, v: Array, a: Array) -> Array:
        """u' of the free quasi-velocities, from a."""
        quasi, t = self.scene.system.quasi, self.t
        assert quasi is not None
        along = lambda t, q, v: quasi.of(t, q, v, self.params)[quasi.free]  # noqa: E731
        return jax.jvp(along, (t, q, v), (jnp.ones_like(t), v, a))[1]


def equations_around(
    scene: Scene,
    params: Any,
    signals: Mapping[str, Any],
    t: Float[Array, ""],
    q: Float[Array, " n"],
    v: Float[Array, " n"],
) -> Equations:
    """The equations around a state.

    Args:
        scene: what is linearized.
        params: as the Lagrangian takes them.
        signals: inputs by name, with the states of the system.
        t: time.
        q: coordinates.
        v: velocities.
    """
    system = scene.system
    values = evaluate(signals, t, q, v, params).peek()
    opened = {name: jnp.asarray(values[name], q.dtype) for name in scene.opened}
    feedback = {name: s for name, s in signals.items() if isinstance(s, Feedback)}
    w = v if system.quasi is None else system.quasi.of(t, q, v, params)[system.quasi.free]
    x = jnp.zeros((0,), q.dtype) if system.states is None else system.states.flat(values)
    parts = [q, w, x.astype(q.dtype), *(jnp.ravel(x) for x in opened.values())]
    return Equations(scene, params, feedback, opened, t, jnp.concatenate(parts))
