"""Every test runs in float64 with strict dtype promotion; warnings of the project are errors.

Most of the time of the tests is compilation. Tests of a module share compiled programs, which are
dropped after the module. A cache on disk keeps them for the next run.
"""

import ctypes
import gc
import os
from importlib.metadata import version
from pathlib import Path

# XLA's emitters of fusions take half of the compile time: they run a pipeline of passes for each
# fusion. LLVM's passes on loops take an eighth. The arithmetic is the same without both. XLA reads
# this once, before the first compilation; jax 0.12 and later have no such option.
if tuple(map(int, version("jax").split(".")[:2])) < (0, 12):
    flags = os.environ.get("XLA_FLAGS", "")
    flags += " --xla_cpu_use_fusion_emitters=false --xla_llvm_disable_expensive_passes=true"
    os.environ["XLA_FLAGS"] = flags

import jax
import pytest
from _footprint import BYTES, MAPS, Footprint, maps, resident_bytes

import jaxlag as jl  # before the first compilation: it sets XLA's bound on small loops
from jaxlag._lowering import ArrayProgram

# A traced program consists of many long-lived objects. Searching them for cycles after every 700
# new ones takes 3 % of the time.
gc.set_threshold(200_000, 20, 100)

# For this process and, through the environment, for processes that tests start.
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

# Tests that run under both lowerings, by module. test_scalar_program compares accelerations and
# derivatives of both for every system.
BOTH = {
    "test_batch": {"test_lanes_equal_single_runs"},
    "test_gradients": {"test_forward_equals_reverse_under_both_lowerings"},
    "test_batching": {"test_compiled_program_loops_over_chunks"},
    "test_both": {
        "test_accelerations_are_compiled_from_the_lowering_in_use",
        "test_solves_are_compiled_from_the_lowering_in_use",
        "test_only_systems_at_auto_follow_the_lowering",
    },
    "test_simulate": {"test_small_oscillation_has_its_closed_form", "test_array_coordinates"},
}


def pytest_configure(config):
    config.pluginmanager.register(Footprint(), "footprint")


def pytest_generate_tests(metafunc):
    module = metafunc.module.__name__.rpartition(".")[2]
    if metafunc.function.__name__ in BOTH.get(module, ()):
        metafunc.parametrize("lowering", ["auto", "array"], indirect=True, scope="module")


trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # glibc: return freed memory to the system


def drop():
    """Drop all compiled programs."""
    jax.clear_caches()
    gc.collect()
    if trim is not None:
        trim(0)


@pytest.fixture(autouse=True)
def bounded():
    """Drop compiled programs within a module at half the bounds of `Footprint`."""
    yield
    if maps() > MAPS / 2 or resident_bytes() > BYTES / 2:
        drop()


@pytest.fixture(scope="module", autouse=True)
def lowering(request):
    """The lowering of systems at "auto": "auto", or "array" for tests that run under both.

    A system is equal to itself under both, so compiled programs must not carry over from one to the
    other. jaxlag's caches hold structure and scalar programs, which do not depend on the lowering
    in use. Fixtures that hold results depend on this one, so that they are computed for each.
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
