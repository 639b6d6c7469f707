"""Every test runs in float64 with strict dtype promotion, and under both lowerings.

Warnings of the project are errors.
"""

import gc
import os
from importlib.metadata import version
from pathlib import Path

# Half of what a test takes is compiling, and half of that is XLA's emitters of fusions, which run
# a pipeline of passes for each. What they replaced emits the same arithmetic. XLA reads this once,
# before the first compilation; from jax 0.12 on there is no choice.
if tuple(map(int, version("jax").split(".")[:2])) < (0, 12):
    flags = os.environ.get("XLA_FLAGS", "")
    os.environ["XLA_FLAGS"] = flags + " --xla_cpu_use_fusion_emitters=false"

import jax
import pytest

import jaxlag as jl  # before the first compilation: it sets XLA's bound on small loops
from jaxlag._lowering import ArrayTerms
from systems._catalogue import ENTRIES

# Traced programs are many small objects that live long: looking through them for cycles after every
# 700 new ones takes 3 % of the time.
gc.set_threshold(200_000, 20, 100)

# No compiled program is kept on disk: few are met twice, and with jax 0.10 a worker that writes
# large ones may crash.
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")

# Modules that compile no accelerations of a system left at "auto", or that choose the lowering
# themselves, or whose numbers do not depend on it: there is nothing to repeat.
ONCE = {
    "test_arguments",
    "test_bench",
    "test_bench_accuracy",
    "test_bench_work_precision",
    "test_bodies_closed_forms",
    "test_coordinates",
    "test_degenerate_states",
    "test_derivative_check",
    "test_documents",
    "test_elimination",
    "test_energy",
    "test_error_estimate",
    "test_fit",
    "test_gradient_modes",
    "test_growth",  # derivatives of solves, which test_gradients repeats
    "test_identifiability",
    "test_kkt",
    "test_linalg",
    "test_lowering_probes",
    "test_lowering_scalar",
    "test_lowering_skipped",
    "test_lowering_trig",
    "test_math",
    "test_methods",
    "test_notebooks",
    "test_one_answer",
    "test_origins",
    "test_partitioned",  # canonical variables are always arrays
    "test_projection",
    "test_quasi_closed_forms",
    "test_requirements",
    "test_rotation",
    "test_slowness",
    "test_solvers",
    "test_splitting",  # both, in a test of its own
    "test_structure",
    "test_systems_errata",
    "test_terms",
    "test_transforms",
    "test_testing",
    "test_xla",
}

# Tests that run under both lowerings in plain pytest, by module; () for all of its tests. The
# others run on arrays with -m full.
BOTH_IN_PLAIN = {
    "test_batch": ("test_lanes_equal_single_runs",),
    "test_gradients": (
        "test_forward_equals_reverse[array-double_pendulum]",
        "test_forward_equals_reverse[array-driven_pendulum]",
        "test_derivative_is_that_of_the_recorded_grid[array-double_pendulum]",
        "test_derivative_is_that_of_the_recorded_grid[array-driven_pendulum]",
    ),
    "test_lanes": ("test_chunks_are_what_is_compiled",),
    "test_lowering_both": (),
    "test_simulate": (
        "test_small_oscillation_has_its_closed_form",
        "test_save_equals_on_demand",
        "test_array_coordinates",
    ),
}

# Tests of every system in the catalogue are repeated on arrays for one of each kind. That both
# lowerings give the same accelerations is tested for all, in test_lowering_scalar.
ON_ARRAYS = {
    "double_pendulum",
    "double_pendulum_rayleigh",  # a dissipation function
    "cart_pendulum",  # forces of time
    "link_spring_mass_equilibrium",  # a state of rest
    "carnival_ride",  # a prescribed motion
    "quadcopter",  # cyclic coordinates, gyroscopic forces
    "spherical_pendulum_elastic",
    "double_pendulum_cartesian",  # holonomic constraints
    "falling_stick_friction",  # forces that depend on multipliers
    "heavy_symmetric_top",  # L in body rates
    "n_link_loop",  # redundant rows
    "rolling_disk",  # quasi-velocities that vanish
    "spherical_pendulum_varying",  # driven constraint
}
# Nothing of these depends on the lowering: they read docstrings, or compare what others found.
NEVER_ON_ARRAYS = {
    "test_every_wrong_number_is_found",
    "test_the_book_place_is_that_of_the_docstring",
    "test_the_docstring_says_what_the_system_is",
    "test_the_identities_cover_every_system_and_every_kind_of_lagrangian",
}


def pytest_generate_tests(metafunc):
    """Every test of a module that is not among ONCE, once for each lowering."""
    if metafunc.module.__name__.rpartition(".")[2] not in ONCE:
        metafunc.parametrize("lowering", ["auto", "array"], indirect=True, scope="module")


def repeated(item):
    """Whether a test is repeated on arrays at all."""
    given = item.callspec.params
    system = given.get("name", given.get("evaluated"))
    return item.originalname not in NEVER_ON_ARRAYS and system not in ENTRIES.keys() - ON_ARRAYS


def pytest_collection_modifyitems(config, items):
    """Drop repetitions on arrays that show nothing new; leave most others out of plain pytest."""
    on_arrays = [
        item
        for item in items
        if getattr(item, "callspec", None) and item.callspec.params.get("lowering") == "array"
    ]
    dropped = [item for item in on_arrays if not repeated(item)]
    config.hook.pytest_deselected(items=dropped)
    left_out = set(dropped)
    items[:] = [item for item in items if item not in left_out]
    for item in on_arrays:
        plain = BOTH_IN_PLAIN.get(item.module.__name__.rpartition(".")[2])
        if plain is None or (plain and not {item.name, item.originalname} & set(plain)):
            item.add_marker(pytest.mark.full)


in_use = "auto"
MEMORY = 4e9  # bytes of a worker beyond which what it has compiled is dropped between modules


def resident():
    """Memory of this process, bytes; 0 where the system does not tell."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE")


@pytest.fixture(scope="module", autouse=True)
def lowering(request):
    """The lowering that systems left at "auto" get in this module: "auto" or "array".

    A system is equal to itself under both, so nothing compiled may be carried over from one to
    the other. The caches of jaxlag hold structure and scalar programs, which do not depend on
    the lowering in use; fixtures that hold results ask for this one, so as to be made anew.
    """
    global in_use
    wanted = getattr(request, "param", "auto")
    if wanted != in_use or resident() > MEMORY:
        jax.clear_caches()
    in_use = wanted
    with pytest.MonkeyPatch.context() as patch:
        if wanted == "array":
            as_declared = jl.System.terms

            def terms(system):
                if system.lowering == "auto":
                    return ArrayTerms(system.lagrangian, system.forces, system.constraints)
                return as_declared.fget(system)

            patch.setattr(jl.System, "terms", property(terms))
        yield wanted
