"""Fits of real recordings: models derived independently, reading of files, reduced sets."""

import gzip
import math
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from bench import __main__ as command
from bench import fits
from bench.fits import _actuated_arm as actuated
from bench.fits import _cube as cube
from bench.fits import _multiarm as multiarm
from bench.fits import _synthetic as synthetic
from bench.fits import _video as video
from bench.fits._data import DataError, folder, pieces, table, windows
from bench.fits._report import Part, errors, missed
from jaxlag import rotation

EPS = np.finfo(float).eps


def written(path, text):
    path.parent.mkdir(parents=True, exist_ok=True)
    with gzip.open(path, "wt") as file:
        file.write(text)
    return path


# ---- Reading -------------------------------------------------------------------------------------


def test_tables_have_comments_and_names(tmp_path):
    path = written(tmp_path / "a.csv.gz", "# of whom\n# units\nseg,t\n1,0.0\n1,0.5\n3,0.25\n")
    columns = table(path)
    assert columns["t"].tolist() == [0.0, 0.5, 0.25]
    found = pieces(columns, "seg")
    assert {number: piece["t"].tolist() for number, piece in found.items()} == {
        1: [0.0, 0.5],
        3: [0.25],
    }


def test_windows_omit_recordings_that_are_too_short():
    long, short = (jl.Experiment(np.arange(n) / 10, {"x": np.arange(n)}) for n in (25, 9))
    assert [len(x.ts) for x in windows([long, short], 1.0)] == [10, 10]
    fine = jl.Experiment(np.arange(497) * 2e-3, {"x": np.arange(497)})
    assert windows([fine], 1.0) == []
    assert len(windows([fine], 0.994)) == 1


def test_prediction_with_a_failed_motion_has_infinite_errors():
    rms = {"rms": lambda channel: np.array([1.0, 2.0])}
    assert missed(SimpleNamespace(failed=(), **rms), "q").tolist() == [1.0, 2.0]
    assert missed(SimpleNamespace(failed=("one",), **rms), "q").tolist() == [np.inf, np.inf]


def test_folder_of_recordings_must_be_named_and_exist(tmp_path, monkeypatch):
    monkeypatch.delenv("JAXLAG_DATA", raising=False)
    with pytest.raises(DataError, match=r"--data must name the folder of recordings, or JAXLAG_"):
        folder(None)
    with pytest.raises(DataError, match=r"--data must name a folder, but .*nowhere is none"):
        folder(str(tmp_path / "nowhere"))
    monkeypatch.setenv("JAXLAG_DATA", str(tmp_path))
    assert folder(None) == tmp_path


def test_command_names_a_missing_folder(tmp_path, capsys):
    assert command.main(["fits", "--data", str(tmp_path / "nowhere")]) == 2
    assert "--data must name a folder" in capsys.readouterr().err


def without_simulation(monkeypatch):
    monkeypatch.setattr(synthetic, "part", lambda quick: Part(errors("a", "b", "c", [1.0]), [], []))


def test_recordings_that_are_missing_are_named(tmp_path, monkeypatch):
    without_simulation(monkeypatch)
    report = fits.run(quick=False, data=str(tmp_path))
    assert len(report.rows) == 1
    named = {reference.figure for reference in report.references}
    assert named == {each.recordings for each in fits.PARTS}
    (tmp_path / "multiarm_pendulum").mkdir()
    named = [reference.figure for reference in fits.run(quick=False, data=str(tmp_path)).references]
    files = {f"multiarm_pendulum/{name}.csv.gz" for name in ("single", "double", "triple")}
    assert files <= set(named)
    assert "multiarm_pendulum" not in named


def test_a_quick_run_names_the_parts_that_it_leaves_out(tmp_path, monkeypatch):
    without_simulation(monkeypatch)
    report = fits.run(quick=True, data=str(tmp_path))
    short = [each for each in fits.PARTS if each.quick is not None]
    long = [each for each in fits.PARTS if each.quick is None]
    assert short
    assert long
    expected = {(each.what, "left out of a quick run") for each in long}
    expected |= {(each.recordings, "not in the folder: left out") for each in short}
    assert set(report.references) == expected


def test_angles_of_a_video_are_relative_to_gravity(tmp_path):
    """Hanging, and the second arm level; both move beyond half a turn."""
    angles = np.linspace(0.0, 5.0, 60)
    joint = 1000 + 500 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    tip = joint + 400 * np.stack([np.cos(angles + 1.5), np.sin(angles + 1.5)], axis=1)
    points = np.concatenate([np.full((60, 2), 1000.0), joint, tip], axis=1)
    lines = "\n".join(",".join(f"{x:.6f}" for x in point) for point in points)
    written(tmp_path / "ibm_double_pendulum" / "9.csv.gz", lines)
    found = video.angles(tmp_path, "9").channels["theta"]
    # Six decimals of 400: 2e-9 rad.
    np.testing.assert_allclose(found, np.stack([angles, angles + 1.5], axis=1), atol=1e-8)


def test_flight_ends_where_a_corner_is_near_the_ground():
    """A sinking cube on its edge: its lowest corner is sqrt(2) half edges below the center."""
    half = np.sqrt(0.5)
    e = np.cos(np.pi / 8), np.sin(np.pi / 8), 0.0, 0.0
    z = np.linspace(0.3, 0.05, 26)
    columns = {"z": z} | {
        name: np.full(26, x) for name, x in zip(("qw", "qx", "qy", "qz"), e, strict=True)
    }
    lowest = z - 2 * half * cube.HALF
    assert cube.flight(columns) == np.count_nonzero(lowest >= cube.CLEAR)
    corners = cube.HALF * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    below = np.min(corners @ np.asarray(rotation.quaternion.matrix(jnp.array(e))).T, axis=0)[2]
    np.testing.assert_allclose(below, -2 * half * cube.HALF, rtol=10 * EPS)


# ---- Models derived independently ----------------------------------------------------------------


@pytest.mark.parametrize("arms", [1, 2, 3])
def test_base_params_give_the_published_lagrangian(arms):
    """The published form by positions of mass centers, and over its first moment of inertia."""
    p = multiarm.PUBLISHED[arms]

    def by_positions(q, v):
        def centers(q):
            joint, found = jnp.zeros(2), []
            for k in range(arms):
                direction = jnp.stack([jnp.sin(q[k]), jnp.cos(q[k])])
                found.append(joint + p[f"a{k + 1}"] * direction)
                joint = joint + p.get(f"L{k + 1}", 0.0) * direction
            return jnp.stack(found)

        x, rate = jax.jvp(centers, (q,), (v,))
        m = jnp.array([p[f"m{k + 1}"] for k in range(arms)])
        I = jnp.array([p[f"I{k + 1}"] for k in range(arms)])  # noqa: E741
        return 0.5 * m @ jnp.sum(rate**2, axis=1) + 0.5 * I @ v**2 - p["g"] * m @ x[:, 1]

    rng = np.random.default_rng(arms)
    base = multiarm.base(arms) | {"zero": jnp.zeros(arms)}
    S, _ = multiarm.matrices(p, arms)
    for _ in range(3):
        q, v = jnp.asarray(rng.uniform(-3, 3, arms)), jnp.asarray(rng.uniform(-9, 9, arms))
        right = by_positions(q, v)
        near = 50 * EPS * float(jnp.sum(jnp.abs(S)) * jnp.max(v**2) + 10.0)
        np.testing.assert_allclose(multiarm.published_lagrangian(0.0, q, v, p), right, atol=near)
        found = S[0, 0] * multiarm.lagrangian(0.0, q, v, base)
        np.testing.assert_allclose(found, right, atol=near)


def test_friction_acts_between_arms():
    """Moments sum to that at the fixed joint; their power is that of the relative rates."""
    v = jnp.array([1.0, -2.0, 0.5])
    p = {"k": jnp.array([0.1, 0.2, 0.3])}
    Q = multiarm.VISCOUS.Q(0.0, jnp.zeros(3), v, p)
    np.testing.assert_allclose(jnp.sum(Q), -0.1 * v[0], rtol=4 * EPS)
    lost = 0.1 * v[0] ** 2 + 0.2 * (v[1] - v[0]) ** 2 + 0.3 * (v[2] - v[1]) ** 2
    np.testing.assert_allclose(Q @ v, -lost, rtol=4 * EPS)


@pytest.mark.parametrize("design", ["A", "C.1"])
def test_lagrangian_of_arms_equals_energies_of_links_and_rotors(design):
    """Links with inertia about their joints; rotors rotate six times as fast as the joints."""
    m1, m2, l1, r1, r2, I1, I2, Ir = actuated.DESIGNS[design]["published"]
    p, g = actuated.published(design), actuated.G
    q, v = jnp.array([0.4, -1.1]), jnp.array([1.3, -0.7])
    w = v[0] + v[1]
    elbow = l1 * v[0]
    links = 0.5 * I1 * v[0] ** 2 + 0.5 * I2 * w**2
    links += 0.5 * m2 * elbow**2 + m2 * elbow * r2 * w * jnp.cos(q[1])
    rotors = 0.5 * Ir * (6 * v[0]) ** 2 + 0.5 * Ir * (6 * v[1] - v[0]) ** 2
    height = -m1 * r1 * jnp.cos(q[0]) - m2 * (l1 * jnp.cos(q[0]) + r2 * jnp.cos(q[0] + q[1]))
    right = links + rotors - g * height
    np.testing.assert_allclose(actuated.arms_lagrangian(0.0, q, v, p), right, rtol=20 * EPS)


# ---- Reduced sets --------------------------------------------------------------------------------


def test_wrong_starts_are_wrong_by_half():
    for seed in range(5):
        start = synthetic.wrong(seed)
        ratios = {name: start[name] / synthetic.TRUE[name] for name in synthetic.TRUE}
        assert {ratios[name] for name in ("m1", "g")} == {1.0}
        assert all(abs(abs(ratios[name] - 1.0) - 0.5) < 4 * EPS for name in synthetic.FREE)
    assert len({tuple(synthetic.wrong(seed).values()) for seed in range(100)}) == 8


def fewest(count, share, chance=1e-4):
    """The least number of successes that chance explains, of `count` with this share each."""
    total = 0.0
    for k in range(count + 1):
        total += math.comb(count, k) * share**k * (1 - share) ** (count - k)
        if total > chance:
            return k
    return count


@pytest.mark.full
def test_params_of_a_chaotic_motion_are_recovered():
    """That all three params are in their 99 % intervals has a probability of 0.97 or more."""
    ts = synthetic.times(float(synthetic.lyapunov_exponent()))
    tally = synthetic.recovered(ts, 8, synthetic.SEGMENTS)
    assert tally.near == 8
    assert tally.found >= fewest(8, 0.97)


@pytest.mark.full
def test_intervals_contain_the_truth_at_the_stated_rate():
    ts = synthetic.times(float(synthetic.lyapunov_exponent()))
    count = 100
    contained = np.round(count * synthetic.coverage(ts, count)).astype(int)
    assert np.all(contained >= fewest(count, 0.95))
    assert np.all(count - contained >= fewest(count, 0.05))
