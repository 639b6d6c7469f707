"""The catalogue itself: every system is collected, is described, and runs."""

import re
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from _families import mostly_full

import jaxlag as jl
import systems
from systems import catalogue
from systems.__main__ import main
from systems._run import TOLERANCE, drifts, simulate_example
from systems.catalogue import ENTRIES, Chart, Entry, Example, UnknownSystem, find

MODULES = {
    path.stem: import_module(f"systems.catalogue.{path.parent.name}.{path.stem}")
    for path in Path(catalogue.__path__[0]).glob("*/*.py")
    if not path.stem.startswith("_")
}


def test_every_module_is_collected_under_its_own_name():
    assert set(ENTRIES) == set(MODULES)
    for name, entry in ENTRIES.items():
        assert entry.name == name
        assert MODULES[name].entry is entry
        assert getattr(systems, name) is MODULES[name]


@pytest.mark.parametrize("name", ENTRIES)
def test_docstring_describes_the_system(name):
    entry = ENTRIES[name]
    doc = MODULES[name].__doc__
    assert 'Pila, "Introduction to Lagrangian Dynamics", ch. ' in doc
    assert "\nParameters" in doc
    for name_in_doc in (*entry.coordinates, *entry.quasi_velocities, *entry.parameter_units):
        assert re.search(rf"\b{name_in_doc}\b", doc), name_in_doc
    head, _ = doc.split("\n\nCoordinate")
    assert sum(line.startswith("    ") for line in head.splitlines()) >= 4  # the sketch


@pytest.mark.parametrize("name", ENTRIES)
def test_docstring_contains_the_place_in_the_book(name):
    doc = " ".join(MODULES[name].__doc__.split())
    entry = ENTRIES[name]
    for figure in re.findall(r"\d\.\d+[a-c]?", entry.book):
        assert figure in doc


OF_EACH_KIND = "cart_pendulum", "sleeve_pendulum_equilibrium", "carnival_ride"


@pytest.mark.parametrize("name", mostly_full(ENTRIES, *OF_EACH_KIND))
def test_the_example_runs(name, capsys):
    assert main(["run", name]) == 0
    out = capsys.readouterr().out
    assert out.startswith(f"{name}: {ENTRIES[name].book}\n")
    if ENTRIES[name].kind != "prescribed":
        assert re.search(r"^status +ok at ", out, re.MULTILINE)
    if ENTRIES[name].kind == "trajectory":
        for row, unit in ENTRIES[name].multiplier_units.items():
            (sizes,) = re.findall(rf"^{row} .*{unit}  (.* \d.*)$", out, re.MULTILINE)
            assert all(float(size) < TOLERANCE for size in re.findall(r"\d\.\de-?\d+", sizes))


def test_list_names_every_system_once(capsys):
    assert main(["list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == list(ENTRIES)


@pytest.mark.full
def test_vanishing_quasi_velocities_are_listed_only_as_constraints(capsys):
    assert main(["run", "chaplygin_sleigh"]) == 0
    head, *others = capsys.readouterr().out.split("\n\n")[1].splitlines()
    units = ("m", "m", "rad", "m/s", "rad/s", "J")
    assert tuple(re.findall(r"\[(.*?)\]", head)[1:]) == units
    assert re.findall(r"(\S+) \[", head) == ["t", "x", "y", "theta", "v", "omega", "V"]
    assert len(others) == 7


@pytest.mark.full
def test_a_parameter_may_be_an_array(capsys):
    assert main(["run", "quadcopter_body_axes"]) == 0
    assert "omega = (516, 512, 511, 515) rad/s" in capsys.readouterr().out


def test_unknown_name_gets_the_nearest_names(capsys):
    with pytest.raises(UnknownSystem, match=r"'duble_pendulum'\. Did you mean double_pendulum"):
        find("duble_pendulum")
    with pytest.raises(UnknownSystem, match=r"'zzz'\. Known: rotating_body_on_frame, disk_"):
        find("zzz")
    assert main(["run", "centralmotion"]) == 1
    assert "Did you mean central_motion" in capsys.readouterr().err


def test_unknown_system_is_not_an_attribute():
    with pytest.raises(AttributeError, match="'systems' has no attribute 'duble_pendulum'"):
        systems.duble_pendulum  # noqa: B018
    with pytest.raises(ImportError):
        from systems import duble_pendulum  # noqa: F401


def declare(**changes):
    """An entry of a one-coordinate system, changed by one field."""
    system = jl.System(lambda t, q, v, params: params["m"] * v[0] ** 2, coordinates=("x",))
    example = Example(params={"m": 1.0}, q0=(0.0,), v0=(1.0,), duration=1.0)
    fields = {
        "name": "free",
        "book": "none",
        "system": system,
        "coordinate_units": ("m",),
        "parameter_units": {"m": "kg"},
        "example": example,
    }
    return Entry(**(fields | changes))


def test_inconsistent_entry_is_refused():
    assert declare().coordinates == ("x",)
    with pytest.raises(ValueError, match=r"free: coordinate_units must have one value for each"):
        declare(coordinate_units=("m", "rad"))
    with pytest.raises(ValueError, match=r"free: quasi_units must have one value for each of no q"):
        declare(quasi_units=("m/s",))
    system = jl.System(
        lambda t, q, u, params: params["m"] * u[0] ** 2,
        coordinates=("x",),
        quasi=jl.QuasiVelocities(lambda t, q, v, params: v, ("speed",)),
        written_in="u",
    )
    assert declare(system=system, quasi_units=("m/s",)).quasi_velocities == ("speed",)
    with pytest.raises(ValueError, match=r"free: quasi_units must have one value for each of spe"):
        declare(system=system)
    with pytest.raises(ValueError, match=r"free: example.params must name the parameters k"):
        declare(parameter_units={"k": "N/m"})
    with pytest.raises(ValueError, match=r"free: multiplier_units must name the constraints \(\)"):
        declare(multiplier_units={"rod": "N"})
    with pytest.raises(ValueError, match=r"free: chart.coordinates must be among x, in this order"):
        declare(chart=Chart(coordinates=("x", "y"), configuration=lambda t, q, params: q))


@pytest.mark.parametrize("name", [name for name, entry in ENTRIES.items() if entry.chart])
def test_chart_satisfies_the_constraints_at_its_coordinates(name):
    entry = ENTRIES[name]
    rng = np.random.default_rng(5)
    params = dict(entry.example.params)
    for _ in range(8):
        own = rng.uniform(-1.5, 1.5, (2, len(entry.file_coordinates)))
        q, v = entry.chart.state(0.7, *own, params)
        np.testing.assert_array_equal(q[entry.file_columns], own[0])
        np.testing.assert_array_equal(v[entry.file_columns], own[1])
        positions, rates = entry.system.residuals(q, v, params, t=0.7)
        for residual in (*positions.values(), *rates.values()):
            np.testing.assert_allclose(residual, 0.0, rtol=0, atol=1e-14)


@pytest.mark.parametrize("suffix", [".png", ".svg"])
@pytest.mark.parametrize(
    "name",
    mostly_full(
        [*OF_EACH_KIND, "atwood_multipliers", "link_spring_mass_equilibrium", "chaplygin_sleigh"],
        *OF_EACH_KIND,
    ),
)
def test_plot_writes_a_figure(name, suffix, tmp_path, capsys):
    """A motion, an equilibrium, a prescribed motion; the first two also under constraints.

    Also a motion in quasi-velocities.
    """
    path = tmp_path / f"figure{suffix}"
    assert main(["run", name, "--plot", str(path)]) == 0
    assert path.stat().st_size > 10_000
    assert str(path) in capsys.readouterr().out


def test_plot_gives_the_reason_for_a_failure(tmp_path, capsys, monkeypatch):
    assert main(["run", "mass_spring", "--plot", str(tmp_path / "no" / "figure.png")]) == 1
    assert "--plot must name a file that can be written, but" in capsys.readouterr().err
    assert main(["run", "mass_spring", "--plot", str(tmp_path / "figure.abc")]) == 1
    assert "abc" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    assert main(["run", "mass_spring", "--plot", str(tmp_path / "figure.png")]) == 1
    assert 'pip install -e ".[plot]"' in capsys.readouterr().err


def test_invariants_are_constant_within_the_tolerance_of_the_run():
    entry = ENTRIES["central_motion"]
    found = dict(drifts(entry, simulate_example(entry)))
    assert set(found) == {"p_phi"}
    assert found["p_phi"] < 100 * TOLERANCE  # 100: local errors of some tens of steps accumulate
