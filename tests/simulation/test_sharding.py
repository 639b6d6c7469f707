"""Motions on several devices: in a separate process, where the CPU counts as two devices."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PROGRAM = """
import json
import jax, jax.numpy as jnp, numpy as np
import jaxlag as jl
from jax.sharding import AxisType, NamedSharding, PartitionSpec as P

jax.config.update("jax_enable_x64", True)
system = jl.System(lambda t, q, v, p: 0.5 * v[0] ** 2 - 0.5 * p * q[0] ** 2, ("x",))
ts, starts = np.array([0.0, 1.0]), np.linspace(0.1, 1.0, 4)[:, None]


def ends(starts):
    def end(q):
        return jl.simulate(system, q, [0.0], ts, 4.0, method="heun", dt=0.25).q[-1]

    return jax.vmap(end)(starts)


def tried(make):
    try:
        return np.asarray(make()).ravel().tolist()
    except ValueError as error:
        return str(error)


auto = jax.make_mesh((2,), ("b",), axis_types=(AxisType.Auto,))
explicit = jax.make_mesh((2,), ("b",), axis_types=(AxisType.Explicit,))
spread = dict(mesh=auto, in_specs=P("b"), out_specs=P("b"))
on = {name: jax.device_put(starts, NamedSharding(mesh, P("b")))
      for name, mesh in (("auto", auto), ("explicit", explicit))}
found = {
    "alone": tried(lambda: ends(starts)),
    "auto": tried(lambda: jax.jit(ends)(on["auto"])),
    "unchecked": tried(lambda: jax.jit(jax.shard_map(ends, check_vma=False, **spread))(starts)),
    "checked": tried(lambda: jax.jit(jax.shard_map(ends, **spread))(starts)),
    "explicit": tried(lambda: jax.jit(ends)(on["explicit"])),
}
print(json.dumps(found))
"""


@pytest.fixture(scope="module")
def found():
    flags = os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=2"
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        env=os.environ | {"XLA_FLAGS": flags},
        cwd=ROOT,
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    return json.loads(done.stdout.splitlines()[-1])


def test_supported_shardings_equal_a_single_device(found):
    assert found["auto"] == pytest.approx(found["alone"], rel=1e-14)
    assert found["unchecked"] == pytest.approx(found["alone"], rel=1e-14)


def test_unsupported_shardings_are_refused(found):
    assert "`simulate` inside shard_map with check_vma=True is not supported" in found["checked"]
    assert "['b']" in found["checked"]
    assert "`simulate` of arrays along explicit axes is not supported" in found["explicit"]
