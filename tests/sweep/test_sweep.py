"""Sweeps: the same bits for every trajectory, whatever surrounds it; statuses; what is kept."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag import Status
from jaxlag._sweep import _block
from jaxlag._sweep._cases import cases_of
from systems.catalogue import ENTRIES

EPS = np.finfo(float).eps
TS = np.linspace(0.0, 2.0, 6)
OPTIONS = {"rtol": 1e-8, "atol": 1e-8, "max_steps": 200}


def lagrangian(t, q, v, p):
    """Two links of equal mass; the second has length l."""
    kinetic = v[0] ** 2 + 0.5 * (p["l"] * v[1]) ** 2
    coupled = p["l"] * v[0] * v[1] * jnp.cos(q[0] - q[1])
    return kinetic + coupled + 9.81 * (2 * jnp.cos(q[0]) + p["l"] * jnp.cos(q[1]))


DOUBLE = jl.System(lagrangian, ("upper", "lower"))


def draw(key, index):
    start, length = jax.random.split(key)
    q0 = jax.random.uniform(start, (2,), minval=-2.0, maxval=2.0)
    return jl.Case(q0, jnp.zeros(2), {"l": 1.0 + 0.1 * jax.random.normal(length)})


def swept(cases, n=None, **options):
    return jl.sweep(DOUBLE, cases, n, TS, **{"simulate_options": OPTIONS, **options})


def stacked(run, indices):
    """The cases of a sweep as arrays."""
    cases = [run.case(int(i)) for i in indices]
    return jax.tree.map(lambda *x: np.stack(x), *cases)


@pytest.fixture(scope="module")
def run():
    return swept(draw, 1100, seed=3)


def same(run, other, pairs):
    """Bit for bit, what was kept and how it ended."""
    for mine, others in pairs:
        for name in run.values:
            np.testing.assert_array_equal(run[name][mine], other[name][others])
        assert run.status[mine] == other.status[others]
        assert run.accepted[mine] == other.accepted[others]


def test_trajectories_do_not_depend_on_their_number(run):
    assert len(run) == 1100
    assert run["upper"].shape == run["lower'"].shape == (1100, 6)
    assert run.ok.all()
    for n in (1, 17, 1025):
        few = swept(draw, n, seed=3)
        assert len(few) == n
        same(few, run, [(i, i) for i in range(n)])
    assert not np.any(swept(draw, 17, seed=4)["upper"][:, 0] == run["upper"][:17, 0])


def test_trajectories_do_not_depend_on_their_neighbours(run):
    """Other places, with neighbours that fail at once, late or not at all."""
    rng = np.random.default_rng(0)
    chosen = rng.choice(1100, 24, replace=False)
    cases = stacked(run, chosen)
    for _ in range(3):
        others = rng.integers(0, 24, 40)
        places = np.sort(rng.choice(40, 12, replace=False))
        q0 = rng.uniform(-3.0, 3.0, (40, 2))
        q0[rng.integers(0, 40, 5)] = np.nan
        lengths = rng.uniform(0.5, 2.0, 40)
        lengths[rng.integers(0, 40, 5)] = 1e-5  # more than max_steps
        q0[places], lengths[places] = cases.q0[others[:12]], cases.params["l"][others[:12]]
        mixed = swept(jl.Case(q0, np.zeros((40, 2)), {"l": lengths}))
        assert not mixed.ok.all()
        same(mixed, run, zip(places, chosen[others[:12]], strict=True))


def test_a_trajectory_is_that_of_simulate(run):
    """Its program differs: a step size in the last bit, and its effect on errors of 1e-8."""
    for i in (0, 600, 1099):
        case = run.case(i)
        alone = jl.simulate(DOUBLE, case.q0, case.v0, TS, case.params, **OPTIONS)
        assert int(alone.stats["accepted"]) == run.accepted[i]
        np.testing.assert_allclose(run["lower"][i], alone["lower"], atol=1e-9)
        np.testing.assert_array_equal(run["lower"][i, 0], case.q0[1])


def test_cases_by_key_and_index_are_those_of_jax():
    drawn = swept(draw, 3, seed=9)
    for i in range(3):
        case = draw(jax.random.fold_in(jax.random.key(9), i), i)
        np.testing.assert_allclose(drawn.case(i).q0, case.q0, rtol=4 * EPS)
        np.testing.assert_allclose(drawn.case(i - 3).params["l"], case.params["l"], rtol=4 * EPS)


def test_failures_are_counted_and_named(run):
    cases = stacked(run, range(4))
    q0, lengths = np.array(cases.q0), np.array(cases.params["l"])
    q0[1], lengths[2] = np.nan, 1e-5
    ended = swept(jl.Case(q0, np.zeros((4, 2)), {"l": lengths}))
    expected = [Status.ok, Status.bad_value, Status.max_steps, Status.ok]
    assert ended.status.tolist() == [int(x) for x in expected]
    assert ended.report.statuses == {"ok": 2, "max_steps": 1, "bad_value": 1}
    assert np.isnan(ended["upper"][2, -1])
    assert 0 < ended.last_time[2] < TS[-1]
    assert ended.report.accepted == ended.accepted.sum()
    lines = ended.message().splitlines()
    assert lines[0] == "4 trajectories: 2 ok, 1 max_steps, 1 bad_value"
    assert any(line.startswith("[2]: max_steps, last good state at t = ") for line in lines)
    assert "2 ok, 1 max_steps" in repr(ended)


def test_replayed_trajectories_have_the_same_bits(run):
    """More times than one solve returns, and fewer."""
    dense = np.sort(np.concatenate([TS, np.linspace(0.0, 2.0, 32)[1:-1]]))
    rows = np.searchsorted(dense, TS)
    for i in (5, -1):
        motion = jl.replay(run, i, dense)
        assert motion.batch_shape == ()
        np.testing.assert_array_equal(motion["upper"][rows], run["upper"][i])
        np.testing.assert_array_equal(motion.rate("lower")[rows], run["lower'"][i])
        np.testing.assert_array_equal(motion.params["l"], run.case(i).params["l"])
        assert int(motion.stats["accepted"]) == run.accepted[i]
        few = jl.replay(run, i, [0.0, 0.7, 2.0])
        np.testing.assert_array_equal(few.ts, [0.0, 0.7, 2.0])
        np.testing.assert_array_equal(np.asarray(few["upper"])[[0, 2]], run["upper"][i, [0, -1]])
        np.testing.assert_array_equal(jl.replay(run, i)["upper"], run["upper"][i])
        np.testing.assert_allclose(motion.energy, motion.energy[0], atol=1e-6)


def test_a_smaller_block_holds_long_records(monkeypatch):
    assert _block.block_size(10) == 1024
    assert _block.block_size(2**28 // 8 // 512) == 512
    assert _block.block_size(10**9) == 64


@pytest.mark.full
def test_two_times_backwards(run):
    """Each further time of a replay is then the end of a solve of its own."""
    cases = stacked(run, range(3))
    back = jl.sweep(DOUBLE, cases, None, [2.0, 0.0], keep=("lower",), simulate_options=OPTIONS)
    motion = jl.replay(back, 1, [2.0, 1.5, 0.5, 0.0])
    np.testing.assert_array_equal(np.asarray(motion["lower"])[[0, -1]], back["lower"][1])
    case = back.case(1)
    alone = jl.simulate(DOUBLE, case.q0, case.v0, motion.ts, case.params, **OPTIONS)
    np.testing.assert_allclose(motion["lower"], alone["lower"], atol=1e-8)
    np.testing.assert_array_equal(motion.last_time, 0.0)
    assert motion.at(1.25).q.shape == (1, 2)


def test_failures_are_replayed(run):
    ended = swept(jl.Case(np.zeros((2, 2)), np.ones((2, 2)), {"l": np.array([1.0, 1e-5])}))
    motion = jl.replay(ended, 1)
    assert motion.status == ended.status[1] == Status.max_steps
    np.testing.assert_array_equal(motion["upper"], ended["upper"][1])
    assert "Raise max_steps" in motion.message()


# ---- What cases consist of -----------------------------------------------------------------------


@pytest.mark.full
def test_dicts_tables_and_own_times():
    """A driven mass: starts by name, an input table and times for each trajectory."""
    system = jl.System(
        lambda t, q, v, p: 0.5 * p["m"] * v[0] ** 2,
        ("x",),
        forces=(jl.GeneralizedForce(lambda t, q, v, p, inputs: inputs["F"][None], "push"),),
    )
    n = 3
    values = np.array([[1.0, 1.0], [2.0, 2.0], [0.5, 0.5]])
    force = jax.vmap(jl.LinearInterpolation)(jnp.tile(jnp.array([0.0, 9.0]), (n, 1)), values)
    cases = jl.Case(
        {"x": np.array([0.1, 0.2, 0.3])},
        [0.0],
        {"m": np.array([1.0, 2.0, 4.0]), "unused": np.broadcast_to(np.eye(2), (n, 2, 2))},
        inputs={
            "F": jax.vmap(jl.LinearInterpolation)(jnp.tile(jnp.array([0.0, 9.0]), (n, 1)), values)
        },
        ts=np.array([[0.0, 1.0], [0.0, 2.0], [0.0, 3.0]]),
    )
    run = jl.sweep(system, cases, None, keep=("x", "energy", "power"))
    t = run.ts[:, 1]
    force, mass = values[:, 0], np.array([1.0, 2.0, 4.0])
    np.testing.assert_allclose(run["x"][:, 1], [0.1, 0.2, 0.3] + force / mass * t**2 / 2, rtol=1e-9)
    np.testing.assert_allclose(run["energy"][:, 1], (force * t) ** 2 / mass / 2, rtol=1e-8)
    assert set(run.values) == {"x", "energy", "power push"}
    assert run.case(1).params["unused"].shape == (2, 2)
    motion = jl.replay(run, 2, [0.0, 1.0, 3.0])
    np.testing.assert_array_equal(np.asarray(motion["x"])[[0, 2]], run["x"][2])
    np.testing.assert_allclose(motion.a[:, 0], 0.125, rtol=1e-12)
    view = run.to_xarray()
    assert dict(view.sizes) == {"motion": 3, "save": 2}
    np.testing.assert_array_equal(view["status"], 0)


OTHERS = {
    "rolling_disk": {},
    "tricycle": {"formulation": "multipliers"},
    "four_bar": {"method": "kvaerno5", "rtol": 1e-7, "atol": 1e-7},
    "spherical_pendulum_fixed": {"method": "gauss4", "dt": 0.02},
}


@pytest.mark.full
@pytest.mark.parametrize("name", OTHERS)
def test_systems_and_methods_of_all_kinds(name):
    """Rows, quasi-velocities, implicit and fixed steps."""
    entry, options = ENTRIES[name], OTHERS[name]
    q0, v0 = entry.start()
    ts = np.linspace(0.0, min(1.0, entry.example.duration), 4)

    def draw(key, index):
        return jl.Case(q0, v0 * (1 + 0.01 * index.astype(float)), dict(entry.example.params))

    run = jl.sweep(entry.system, draw, 20, ts, simulate_options=options)
    few = jl.sweep(entry.system, draw, 3, ts, simulate_options=options)
    assert run.ok.all()
    for kept in run.values:
        np.testing.assert_array_equal(run[kept][:3], few[kept])
    case = run.case(7)
    alone = jl.simulate(entry.system, case.q0, case.v0, ts, case.params, **options)
    replayed = jl.replay(run, 7)
    for kept in run.values:
        np.testing.assert_array_equal(replayed[kept], run[kept][7])
        np.testing.assert_allclose(run[kept][7], alone[kept], atol=1e-7)


# ---- Bad input -----------------------------------------------------------------------------------


SHAPES = jl.Case(np.zeros((3, 2)), np.zeros(2), {"l": np.ones(4)})
SPREAD = jl.Case(np.zeros((3, 2)), np.zeros(2), {"l": np.ones(3)})


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"system": 3}, "`system` must be a jl.System"),
        ({"cases": 3}, r"`cases` must be a function of \(key, index\), or a jl.Case of arrays"),
        ({"n": 0}, "`n` must be a positive integer, but it was 0"),
        ({"n": None}, "`n` must be a positive integer, but it was None"),
        ({"n": 2.0}, "`n` must be a positive integer"),
        ({"seed": 1.5}, r"`seed` must be an integer from 0 to 2\^32 - 1, but it was 1.5"),
        ({"seed": -1}, "`seed` must be an integer"),
        ({"ts": None}, "exactly one of `ts` and the `ts` of the cases must be given, but neither"),
        ({"ts": [0.0, 0.0]}, "`ts` must be strictly monotone"),
        ({"keep": "upper"}, "`keep` must be a sequence of names"),
        ({"keep": ("uper",)}, "`keep` must name some of .* but one was 'uper'"),
        ({"keep": ()}, "`keep` must name something"),
        ({"keep": ("kinetic",)}, "must name energies that the system declares"),
        ({"simulate_options": {"rtoll": 1}}, "`simulate_options` must be among"),
        ({"simulate_options": {"save": ()}}, "`save` must be left out, since jl.sweep sets it"),
        ({"cases": SHAPES, "n": None}, r"`cases.params\['l'\]` must have a leading axis of 3, as "),
        (
            {"cases": SPREAD, "n": 4},
            "`cases.q0` must have a leading axis of 4, as n, but that was 3",
        ),
        ({"cases": jl.Case([0.0, 0.0]), "n": None}, "`cases` must have an array with a leading"),
        (
            {"cases": jl.Case(np.broadcast_to(1.0, (2,))), "n": None},
            "must have an array",
        ),
        ({"cases": jl.Case(np.zeros((3, 3)))}, r"q0` must have shape \(2,\) or \(n, 2\), but its"),
        ({"cases": jl.Case(np.zeros((3, 2)), ts=1.0)}, "ts` must be at least 2 times"),
        ({"cases": jl.Case(np.zeros((2, 2)), ts=np.ones((2, 3)))}, "ts` must be strictly monotone"),
        (
            {"cases": jl.Case(np.zeros((2, 2)), params={"on": np.array([True, False])})},
            r"`cases.params\['on'\]` must be numbers where trajectories differ",
        ),
        ({"cases": jl.Case}, "`cases` must be a function of"),
        ({"cases": lambda key: jl.Case([0.0, 0.0])}, r"`cases` must take \(key, index\)"),
        ({"keep": ("u",)}, "`keep` must name quantities of the system"),
        ({"simulate_options": {"atol": {"upper": 1e-9}}}, "`atol` must be one number"),
        ({"cases": jl.Case("no", [0.0, 0.0])}, "q0` must be numbers, but it was 'no'"),
        (
            {"cases": lambda key, i: {"q0": 1}},
            "`cases` must return a jl.Case, but it returned a dict",
        ),
    ],
)
def test_bad_arguments_are_named(changed, message):
    given = {"system": DOUBLE, "cases": draw, "n": 10, "ts": TS} | changed
    with pytest.raises(ValueError, match=message):
        jl.sweep(**given)


def test_functions_that_cannot_be_drawn_from():
    def branches(key, index):
        return jl.Case([0.0 if index > 3 else 1.0, 0.0], [0.0, 0.0], {"l": 1.0})

    rng = np.random.default_rng(0)

    def number(key, index):
        return jl.Case([rng.normal(), 0.0], [0.0, 0.0], {"l": 1.0})

    def array(key, index):
        return jl.Case(jnp.asarray(rng.normal(size=2)), [0.0, 0.0], {"l": 1.0})

    with pytest.raises(ValueError, match="`cases` must be traceable by JAX, but it needed a value"):
        swept(branches, 3)
    for changing in (number, array):
        with pytest.raises(ValueError, match="`cases` must depend on key and index alone"):
            swept(changing, 3)


def test_cases_are_equal_if_their_programs_are():
    """Also by constants of programs in the program, and by the seed's own place."""

    def scaled(scale):
        spread = jax.jit(lambda x: x * np.full(2, scale))
        return lambda key, index: jl.Case(spread(jax.nn.relu(jnp.ones(2))), params={"l": 1.0})

    one, same, other = (cases_of(DOUBLE, scaled(scale), 3, 0)[0] for scale in (1.0, 1.0, 0.5))
    assert one == same
    assert hash(one.static) == hash(same.static)
    assert one != other
    assert cases_of(DOUBLE, scaled(1.0), 3, 7)[0].form == one.form


@pytest.mark.full
def test_values_from_outside_are_those_of_the_sweep():
    """Also constants of programs in the program; a function written again has the same program."""
    outside = {"scale": 1.0}

    def scaled():
        table = np.full(2, outside["scale"])
        spread = jax.jit(lambda x: x * table)
        return lambda key, index: jl.Case(
            spread(jax.nn.relu(jnp.ones(2))), jnp.zeros(2), {"l": 1.0, "scale": outside["scale"]}
        )

    compiled = _block.solve_block._cache_size()
    draw_once = scaled()
    first, again = swept(draw_once, 2), swept(scaled(), 2)
    assert _block.solve_block._cache_size() == compiled + 1
    outside["scale"] = 0.5
    later = swept(scaled(), 2)
    np.testing.assert_array_equal(first["upper"], again["upper"])
    np.testing.assert_array_equal(later["upper"][:, 0], 0.5)
    # The function reads another value now; the sweep has been drawn.
    assert first.case(0).params["scale"] == jl.replay(first, 0).params["scale"] == 1.0
    assert later.case(0).params["scale"] == 0.5


def test_programs_that_change_or_call_back_are_refused():
    count = iter(range(9))

    def counts(key, index):
        return jl.Case([0.0, 0.0], [0.0, 0.0], {"l": 1.0, "k": next(count)})

    def calls(key, index):
        length = jax.pure_callback(lambda: np.ones(()), jax.ShapeDtypeStruct((), jnp.dtype(float)))
        return jl.Case([0.0, 0.0], [0.0, 0.0], {"l": length})

    with pytest.raises(ValueError, match="`cases` must depend on key and index alone"):
        swept(counts, 3)
    with pytest.raises(
        ValueError, match=r"`cases` must be computed by JAX alone, .* pure_callback"
    ):
        swept(calls, 3)


def test_bad_names_indices_and_times(run):
    with pytest.raises(KeyError, match=r"must be one of .*'upper'"):
        run["uper"]
    with pytest.raises(IndexError, match=r"be that of one of 1100 trajectories, but it was 1100"):
        run.case(1100)
    with pytest.raises(ValueError, match=r"`index` must be an integer, but it was 1.0"):
        run.index(1.0)
    with pytest.raises(ValueError, match=r"`run` must be a result of jl.sweep"):
        jl.replay(3, 1)
    with pytest.raises(ValueError, match=r"`ts` must begin at 0.0 and end at 2.0, as the sweep"):
        jl.replay(run, 1, [0.0, 1.0])
