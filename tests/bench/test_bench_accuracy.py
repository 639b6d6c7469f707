"""The accuracy benchmark: its formulas, its arithmetic of many digits, its references."""

import json
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from bench import accuracy
from bench._multiprecision import make_references as references
from bench._problems.starts import STARTS, Start
from bench.accuracy._verdict import EPS, Errors, conclusions, judged, name_exact, scaled
from systems.catalogue import ENTRIES

FILES = accuracy.MOVING


def errors(saves, *, kappa=100.0, steps=100, size=1e4, ends=None, estimates=None):
    """Errors at made-up saves; the floor is 10 eps kappa sqrt(steps) size, 2.2e-8 by default."""
    saves = np.array(saves, float)
    return Errors(
        saves=saves,
        ends=saves if ends is None else np.array(ends, float),
        saves_at_ends=saves,
        estimates=1.5 * saves if estimates is None else np.array(estimates, float),
        size=np.full(saves.shape, size),
        kappa=np.full(saves.shape, kappa),
        steps=steps,
    )


def test_errors_are_in_units_of_the_tolerance():
    found = scaled(np.array([[3e-6, 8e-6]]), np.array([[0.0, -1.0]]), 1e-6, 1e-6)
    np.testing.assert_allclose(found, [5.0], rtol=1e-14)  # 3 and 8 / 2


@pytest.mark.parametrize(
    ("largest", "verdict"), [(999.0, "within"), (1001.0, "beyond"), (np.nan, "beyond")]
)
def test_the_upper_bound_is_ten_kappa(largest, verdict):
    row = judged(errors([1.0, largest, 2.0]))
    assert row["upper"] == verdict
    if np.isfinite(largest):
        assert math.isclose(row["of_bound"], largest / 1000, rel_tol=1e-9)
    else:
        assert row["of_bound"] == math.inf


def test_upper_bound_has_the_floor_of_rounding():
    floor = 10 * EPS * 100 * 10 * 1e13
    assert judged(errors([1000 + 0.99 * floor], size=1e13))["upper"] == "within"
    assert judged(errors([1000 + 1.01 * floor], size=1e13))["upper"] == "beyond"
    assert math.isclose(judged(errors([1.0], size=1e13))["floor"], floor)


def test_bound_uses_the_kappa_of_each_time():
    found = errors([50.0, 50.0])._replace(kappa=np.array([1.0, 100.0]))
    assert judged(found)["upper"] == "beyond"
    assert judged(found._replace(kappa=np.array([100.0, 100.0])))["upper"] == "within"


@pytest.mark.parametrize(
    ("largest", "steps", "verdict"),
    [
        (2e-3, 20, "within"),
        (0.9e-3, 20, "below"),
        (0.9e-3, 19, "few steps"),
        (1e-9, 100, "floor"),
        (1e-9, 19, "floor"),
    ],
)
def test_lower_bound_depends_on_error_steps_and_floor(largest, steps, verdict):
    assert judged(errors([1e-10, largest], steps=steps))["lower"] == verdict


def test_motions_that_never_leave_the_floor_are_exact():
    rows = [judged(errors([1e-9])) for _ in range(3)]
    name_exact(rows)
    assert [row["lower"] for row in rows] == ["exact"] * 3
    rows = [judged(errors([1e-9])), judged(errors([1.0]))]
    name_exact(rows)
    assert [row["lower"] for row in rows] == ["floor", "within"]


def test_errors_at_saves_are_compared_with_those_at_step_ends():
    assert judged(errors([2.0, 6.0], ends=[4.0, 1.0]))["saves_to_ends"] == 1.5
    assert judged(errors([1e-9], ends=[1e-10]))["saves_to_ends"] is None  # only rounding


def test_estimates_are_compared_at_every_save_above_rounding():
    found = judged(errors([1e-12, 1.0, 2.0, 1.5], estimates=[5.0, 0.5, 4.0, 4.5]))
    figures = [found[f"estimate_{which}"] for which in ("least", "most", "of_largest")]
    assert figures == [0.5, 3.0, 2.0]
    assert judged(errors([1e-12], estimates=[5.0]))["estimate_of_largest"] is None
    assert math.isnan(judged(errors([1.0, np.nan]))["estimate_least"])


def row(**changes):
    about = {"system": "a", "start": "regular", "rtol": 1e-4}
    return about | judged(errors([1.0])) | changes


@pytest.mark.parametrize(
    ("changes", "missed"),
    [
        ({}, None),
        ({"upper": "beyond", "of_bound": math.inf}, 0),
        ({"lower": "below", "error": 1e-4}, 1),
        ({"saves_to_ends": 2.1}, 2),
        ({"estimate_least": 0.3}, 3),
        ({"estimate_most": 101.0}, 3),
        ({"estimate_least": math.nan}, 3),
    ],
)
def test_every_miss_is_counted_and_named(changes, missed):
    targets, lines = conclusions([row(), row(system="b", **changes)])
    assert [target.met for target in targets] == [k != missed for k in range(4)]
    named = [line.what for line in lines if "MISSED" in line.what]
    assert len(named) == (missed is not None)
    assert all("b (regular) to 1e-04" in what for what in named)


def test_every_moving_system_has_two_references_with_its_parameters():
    assert sorted(STARTS) == sorted(FILES)
    stored = sorted(path.stem for path in references.FOLDER.glob("*.json"))
    assert stored == sorted(FILES)
    for name in FILES:
        params, motions = references.load(name)
        assert params == references.plain(ENTRIES[name].example.params), name
        starts = STARTS[name]
        assert [motion.start for motion in motions] == [start.name for start in starts], name
        for motion, start in zip(motions, starts, strict=True):
            assert motion.times[-1] == start.duration
            assert motion.y.shape == (references.SAVES, 2 * ENTRIES[name].system.size)
            assert motion.agreement <= references.AGREEMENT
            if not ENTRIES[name].system.constraints:
                np.testing.assert_array_equal(motion.y[0], [*start.q0, *start.v0])


def test_the_files_are_small():
    assert sum(path.stat().st_size for path in references.FOLDER.glob("*.json")) < 1.5e6


class TestManyDigits:
    """Equations and integration against closed forms, to 1e-20 and better."""

    @pytest.fixture(autouse=True)
    def gmpy2(self):
        return pytest.importorskip("gmpy2")

    def follow(self, system, q, v, times, params=None):
        from bench._multiprecision.equations import Motion
        from bench._multiprecision.extrapolation import integrated

        motion = Motion(system, params or {})
        start = motion.start(q, v)
        states, _ = integrated(motion.rates, start, times, 1e-26, 13)
        return states

    def test_operations_equal_those_of_jax(self, gmpy2):
        from bench._multiprecision.equations import precise
        from bench._multiprecision.jaxpr_code import Floats, Tape, compiled, read

        precise()

        def function(x, k):
            table = jnp.stack([jnp.sin(x), jnp.cos(x) ** 3, jnp.arctan2(x, 2.0 + x**2)])
            chosen = jnp.where(x > 0.1, table[k], jnp.exp(-x) @ table[:, ::-1].T @ jnp.ones(3))
            more = jnp.cumsum(x)[1:] + jnp.maximum(x[:2], x[1:]) - jnp.abs(x[1:]) * jnp.sign(x[0])
            powers = jnp.power(1 + x**2, 0.3) / jnp.sqrt(2 + x) + jnp.linalg.norm(x)
            turned = jnp.cross(x, jnp.tanh(x)).at[1].set(x[2]) + jnp.log1p(x**2)
            slopes = jax.jacfwd(lambda x: jnp.einsum("i,ij,j", x, jnp.outer(x, x), x))(x)
            return jnp.concatenate([chosen, more, powers, turned, slopes])

        tape = Tape()
        ids = read(tape, function, Floats(tape.inputs("x", (3,))), 2)
        program = compiled(tape, ids, ("x",))
        expected = jax.jit(lambda x: function(x, 2))
        for x in ([0.3, -0.7, 1.9], [-0.4, 0.2, 0.8]):
            found = np.array([float(y) for y in program([gmpy2.mpfr(a) for a in x])])
            np.testing.assert_allclose(found, expected(jnp.array(x)), rtol=1e-14, atol=1e-15)

    def test_reading_outside_an_array_is_refused(self):
        from bench._multiprecision.jaxpr_code import Floats, Tape, read

        tape = Tape()
        x = Floats(tape.inputs("x", (3,)))
        with pytest.raises(NotImplementedError, match="outside"):
            read(tape, lambda x: x.at[jnp.array([5])].get(mode="fill", fill_value=-1), x)

    def test_mass_on_a_spring_agrees_with_its_closed_form(self, gmpy2):
        def lagrangian(t, q, v, params):
            return 0.5 * v[0] ** 2 - 0.5 * params["k"] * q[0] ** 2

        times = [0.0, 1.0, 7.0]
        system = jl.System(lagrangian, coordinates=("x",))
        for t, y in zip(times, self.follow(system, [0.25], [1.0], times, {"k": 2.25}), strict=True):
            t = gmpy2.mpfr(t)
            x = gmpy2.cos(1.5 * t) / 4 + gmpy2.sin(1.5 * t) / gmpy2.mpfr(1.5)
            assert abs(y[0] - x) < 1e-24

    def test_kepler_orbit_agrees_with_its_closed_form(self, gmpy2):
        """A Kepler orbit, e = 1/2, a = 1, from the pericenter."""

        def lagrangian(t, q, v, params):
            return 0.5 * v @ v + 1 / jnp.linalg.norm(q)

        from bench._multiprecision.equations import precise

        precise()
        system = jl.System(lagrangian, coordinates=("x", "y"))
        time = gmpy2.mpfr(4.0)
        E = gmpy2.mpfr(4)
        for _ in range(20):  # Kepler's equation by Newton's method
            E -= (E - gmpy2.sin(E) / 2 - time) / (1 - gmpy2.cos(E) / 2)
        from bench._multiprecision.equations import Motion
        from bench._multiprecision.extrapolation import integrated

        motion = Motion(system, {})
        half, zero = gmpy2.mpfr("0.5"), gmpy2.mpfr(0)
        start = [half, zero, zero, gmpy2.sqrt(gmpy2.mpfr(3))]
        states, _ = integrated(motion.rates, start, [0.0, 4.0], 1e-26, 13)
        assert abs(states[-1][0] - (gmpy2.cos(E) - half)) < 1e-22
        assert abs(states[-1][1] - gmpy2.sqrt(1 - half**2) * gmpy2.sin(E)) < 1e-22

    def test_constrained_bead_on_a_circle_agrees_with_the_free_one(self, gmpy2):
        def cartesian(t, q, v, params):
            return 0.5 * v @ v - params["g"] * q[1]

        def polar(t, q, v, params):
            return 0.5 * v[0] ** 2 + params["g"] * jnp.cos(q[0])

        circle = jl.Holonomic(lambda t, q, params: q @ q - 1.0, "circle")
        free = jl.System(polar, coordinates=("theta",))
        held = jl.System(cartesian, coordinates=("x", "y"), constraints=(circle,))
        from bench._multiprecision.equations import Motion
        from bench._multiprecision.extrapolation import integrated

        motion = Motion(held, {"g": 9.81})
        start = motion.start([0.6, -0.8], [0.4, 0.3])
        angle = gmpy2.atan2(start[0], -start[1])
        rate = -start[1] * start[2] + start[0] * start[3]
        assert abs(start[0] ** 2 + start[1] ** 2 - 1) < 1e-40
        found = integrated(motion.rates, start, [0.0, 3.0], 1e-26, 13)[0][-1]
        rates = Motion(free, {"g": 9.81}).rates
        theta = integrated(rates, [angle, rate], [0.0, 3.0], 1e-26, 13)[0][-1][0]
        assert abs(found[0] - gmpy2.sin(theta)) < 1e-21
        assert abs(found[1] + gmpy2.cos(theta)) < 1e-21

    def test_contradictory_rows_are_refused(self):
        from bench._multiprecision.equations import Singular

        two = [jl.Holonomic(lambda t, q, params, r=r: q @ q - r, f"r{r}") for r in (1.0, 4.0)]
        system = jl.System(
            lambda t, q, v, params: 0.5 * v @ v, coordinates=("x", "y"), constraints=two
        )
        with pytest.raises(Singular):
            self.follow(system, [1.0, 0.0], [0.0, 1.0], [0.0, 1.0])

    def test_heavy_top_has_constant_momenta_and_energy(self, gmpy2):
        """The momenta of psi and phi and the energy at the saves of its file."""
        from bench._multiprecision.equations import precise

        precise()
        content = json.loads((references.FOLDER / "heavy_symmetric_top.json").read_text())
        p = {name: gmpy2.mpfr(value) for name, value in content["params"].items()}
        for motion in content["motions"]:
            constants = [
                self.of_top(gmpy2, p, [gmpy2.mpfr(x) for x in q], [gmpy2.mpfr(x) for x in v])
                for q, v in zip(motion["q"], motion["v"], strict=True)
            ]
            for values in zip(*constants, strict=True):
                assert max(abs(x - values[0]) / (1 + abs(values[0])) for x in values) < 1e-20

    def of_top(self, gmpy2, p, q, v):
        """(p_psi, p_phi, E), Goldstein, Classical Mechanics, sec. 5.7."""
        sin, cos = gmpy2.sin(q[1]), gmpy2.cos(q[1])
        spin = p["I3"] * (v[2] + v[0] * cos)
        about = p["I1"] * v[0] * sin**2 + spin * cos
        kinetic = (p["I1"] * (v[1] ** 2 + (v[0] * sin) ** 2) + spin**2 / p["I3"]) / 2
        return spin, about, kinetic + p["m"] * p["g"] * p["l"] * cos

    @pytest.mark.parametrize("name", ["simple_pendulum", "falling_stick_multiplier"])
    def test_file_is_reproduced_digit_by_digit(self, name):
        entry = ENTRIES[name]
        stored = json.loads((references.FOLDER / f"{name}.json").read_text())["motions"]
        again = references.made(entry.system, entry.example.params, STARTS[name][:1])
        assert references.differences(stored[0], again[0]) <= references.AGREEMENT
        params = entry.example.params | {"g": entry.example.params["g"] * (1 + 2e-16)}
        wrong = references.made(entry.system, params, STARTS[name][:1])
        assert references.differences(stored[0], wrong[0]) > references.AGREEMENT

    def test_command_compares_with_the_file(self, tmp_path, monkeypatch, capsys):
        text = (references.FOLDER / "hockey_puck.json").read_text()
        monkeypatch.setattr(references, "FOLDER", tmp_path)
        path = tmp_path / "hockey_puck.json"
        path.write_text(text)
        assert references.main(["--check", "hockey_puck"]) == 0
        assert path.read_text() == text
        first = json.loads(text)["motions"][0]["q"][3][0]
        path.write_text(text.replace(first, f"{first[:12]}{(int(first[12]) + 1) % 10}{first[13:]}"))
        assert references.main(["--check", "hockey_puck"]) == 1
        assert "NOT TRUSTED" in capsys.readouterr().out

    def test_wrong_digit_is_detected(self):
        content = json.loads((references.FOLDER / "simple_pendulum.json").read_text())
        motion = content["motions"][0]
        assert references.differences(motion, motion) == 0
        digits, exponent = motion["q"][7][0].split("e")
        place = digits.index(".") + 17
        changed = str((int(digits[place]) + 5) % 10)
        text = f"{digits[:place]}{changed}{digits[place + 1 :]}e{exponent}"
        wrong = motion | {"q": [*motion["q"][:7], [text], *motion["q"][8:]]}
        assert references.differences(motion, wrong) > references.AGREEMENT


def test_failed_motion_is_beyond_its_bound(monkeypatch):
    params, motions = references.load("simple_pendulum")
    monkeypatch.setattr(accuracy, "rows_of", lambda *_: 1 / 0)
    (row,) = accuracy.safely("simple_pendulum", params, motions[0], (1e-4,))
    assert "ZeroDivisionError" in row["grows"]
    targets, lines = conclusions([row])
    assert not targets[0].met
    assert "simple_pendulum (regular) to 1e-04, MISSED" in lines[0].what


@pytest.mark.full
def test_only_a_wrong_reference_is_beyond_the_bound():
    params, motions = references.load("simple_pendulum")
    right = accuracy.rows_of("simple_pendulum", params, motions[0], (1e-5, 1e-9))
    assert [row["upper"] for row in right] == ["within"] * 2
    assert [row["lower"] for row in right] == ["within"] * 2
    assert right[0]["steps"] < right[1]["steps"]
    wrong = motions[0].y.copy()
    wrong[20, 0] += 1e-5
    moved = accuracy.rows_of("simple_pendulum", params, motions[0]._replace(y=wrong), (1e-9,))
    assert moved[0]["upper"] == "beyond"


def test_starts_are_two_of_different_energy():
    for name, (first, second) in STARTS.items():
        assert isinstance(first, Start)
        assert first.name == "regular"
        assert second.name in ("chaotic", "energetic")
        assert (first.q0, first.v0) != (second.q0, second.v0), name
