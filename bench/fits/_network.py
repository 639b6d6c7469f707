"""A neural network added to a physical model: an unknown potential of the free single pendulum.

The physical model is L = 1/2 w^2 - G cos(theta - zero) with viscous friction, falling dry friction
and drag. The network adds a potential of the angle. All parameters are trained together by
gradients on whole segments, starting from the fit of the physical model alone. The network is a
potential, so energy is conserved: without friction it is constant to the solver's tolerance.
"""

from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array

import jaxlag as jl
from bench._harness.timing import Target
from bench.fits import _multiarm as multiarm
from bench.fits._report import Figure, Part, missed, timed

PHYSICS = multiarm.candidates(1)["viscous, falling, drag"]
EVERY = 20  # ms
WIDTH = 8
SHARP = 3.0  # scale of the network's inputs: the potential may change within a third of a radian
EPOCHS = 300
MEMORY = 20
COORDINATES = {"theta": (1,)}


def learned(t: Any, q: Array, v: Array, p: Any) -> Array:
    """L with the network's potential."""
    x = SHARP * jnp.stack([jnp.cos(q[0]), jnp.sin(q[0])])
    return multiarm.lagrangian(t, q, v, p) - p["net"](x)


def drift(params: Any) -> float:
    """Largest change of energy in 10 s without friction, divided by G."""
    system = jl.System(learned, COORDINATES)
    ts = np.linspace(0.0, 10.0, 201)
    motion = jl.simulate(system, [2.0], [0.0], ts, params, rtol=1e-11, atol=1e-11)
    energy = np.asarray(motion.energy)
    return float(np.max(np.abs(energy - energy[0])) / np.abs(params["G1"]))


def measured(path: Path) -> Part:
    """Both models, tested on segments that were not used for training."""
    name, model = "single pendulum", "physics and a network's potential"
    segments = multiarm.recordings(path, 1, EVERY)
    train = [x for number, x in segments.items() if number % 3]
    test = [x for number, x in segments.items() if number % 3 == 0]
    params0 = multiarm.base(1) | {"zero": np.zeros(1)} | PHYSICS.params0
    free, options = tuple(params0), {"transforms": PHYSICS.transforms} | multiarm.OPTIONS
    plain = jl.System(multiarm.lagrangian, COORDINATES, forces=PHYSICS.forces)
    physics = jl.fit(plain, train, params0, free=free, **options)
    # Without a constant, which no motion determines.
    key = jax.random.key(0)
    network = eqx.nn.MLP(2, "scalar", WIDTH, 1, jnp.tanh, use_final_bias=False, key=key)
    both = jl.System(learned, COORDINATES, forces=PHYSICS.forces)
    descent = jl.Descent(optax.lbfgs(memory_size=MEMORY), epochs=EPOCHS, batch=len(train))

    def fit() -> jl.FitResult:
        start = physics.params | {"net": network}
        return jl.fit(both, train, start, free=(*free, "net"), optimizer=descent, **options)

    found, figures = timed(name, model, fit, repeats=1)
    figures.append(Figure(name, model, "numbers trained", "1", float(len(found.names))))

    def compared(what: str, others: list[jl.Experiment]) -> Figure:
        own, alone = (1e3 * missed(x.predict(others), "theta")[0] for x in (found, physics))
        return Figure(
            name, model, f"rms of {what}", "mrad", own, None, None, alone, "physics alone"
        )

    figures.append(compared("training", train))
    for each in test:
        swing = float(np.max(np.abs(each.channels["theta"] - np.pi)))
        figures.append(compared(f"test, {each.name}, swings of {swing:.2f} rad", [each]))
    change = drift(found.params)
    figures.append(Figure(name, model, "drift of energy without friction, over G", "1", change))
    claim = "of G: drift of energy with a network's potential"
    return Part(figures, [Target(claim, change, "<=", 1e-9)], [])
