"""Every test runs in float64 with strict dtype promotion; warnings of the project are errors.

Compiling is what the tests cost. A module shares its programs, they are dropped after it, and what
was compiled is kept on disk for the next run.
"""

import ctypes
import gc
import os
from importlib.metadata import version
from pathlib import Path

# Half of the time of compiling goes to XLA's emitters of fusions, which run a pipeline of passes
# for each, and an eighth to what LLVM does to loops; without both the arithmetic is the same. XLA
# reads this once, before the first compilation; from jax 0.12 on there is no choice.
if tuple(map(int, version("jax").split(".")[:2])) < (0, 12):
    flags = os.environ.get("XLA_FLAGS", "")
    flags += " --xla_cpu_use_fusion_emitters=false --xla_llvm_disable_expensive_passes=true"
    os.environ["XLA_FLAGS"] = flags

import jax
import pytest
from _footprint import BYTES, MAPS, Footprint, held, maps

import jaxlag as jl  # before the first compilation: it sets XLA's bound on small loops
from jaxlag._lowering import ArrayProgram

# Traced programs are many small objects that live long: looking through them for cycles after every
# 700 new ones takes 3 % of the time.
gc.set_threshold(200_000, 20, 100)

# Here and, by the environment, in the processes that tests start.
caches = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
for setting, value in {
    "jax_compilation_cache_dir": str(caches / "jaxlag-tests"),
    "jax_persistent_cache_min_compile_time_secs": 0.0,
    "jax_persistent_cache_min_entry_size_bytes": -1,
}.items():
    value = type(value)(os.environ.setdefault(setting.upper(), str(value)))
    jax.config.update(setting, value)

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")

# Tests that run under both lowerings, by module. That both give the same accelerations and
# derivatives is tested for every system in test_scalar_program.
BOTH = {
    "test_batch": {"test_lanes_equal_single_runs"},
    "test_gradients": {"test_forward_equals_reverse_under_both_lowerings"},
    "test_batching": {"test_chunks_are_what_is_compiled"},
    "test_both": {
        "test_accelerations_are_compiled_from_the_lowering_in_use",
        "test_solves_are_compiled_from_the_lowering_in_use",
        "test_only_systems_left_at_auto_follow",
    },
    "test_simulate": {"test_small_oscillation_has_its_closed_form", "test_array_coordinates"},
}


def pytest_configure(config):
    config.pluginmanager.register(Footprint(), "footprint")


def pytest_generate_tests(metafunc):
    module = metafunc.module.__name__.rpartition(".")[2]
    if metafunc.function.__name__ in BOTH.get(module, ()):
        metafunc.parametrize("lowering", ["auto", "array"], indirect=True, scope="module")


trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # glibc's: memory freed goes back


def drop():
    """Let go of everything compiled."""
    jax.clear_caches()
    gc.collect()
    if trim is not None:
        trim(0)


@pytest.fixture(autouse=True)
def bounded():
    """A module of many programs lets go of them on the way, half the bounds of the guard left."""
    yield
    if maps() > MAPS / 2 or held() > BYTES / 2:
        drop()


@pytest.fixture(scope="module", autouse=True)
def lowering(request):
    """The lowering that systems left at "auto" get: "auto", or "array" where a test asks for both.

    A system is equal to itself under both, so nothing compiled may be carried over from one to
    the other. The caches of jaxlag hold structure and scalar programs, which do not depend on
    the lowering in use; fixtures that hold results ask for this one, so as to be made anew.
    """
    wanted = getattr(request, "param", "auto")
    with pytest.MonkeyPatch.context() as patch:
        if wanted == "array":
            as_declared = jl.System._program

            def program(system):
                if system.lowering == "auto":
                    return ArrayProgram(system._terms)
                return as_declared.fget(system)

            patch.setattr(jl.System, "_program", property(program))
        yield wanted
    drop()
