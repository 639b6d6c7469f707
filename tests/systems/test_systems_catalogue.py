"""The catalogue itself: every system collected, described, and running."""

import re
import sys
from importlib import import_module
from pathlib import Path

import pytest

import jaxlag as jl
import systems
from systems.__main__ import main
from systems._catalogue import ENTRIES, UnknownSystem, find
from systems._entry import Entry, Example
from systems._run import TOLERANCE, drifts, simulate_example

JOBS = {"errata", "fit_pendulum"}
"""Public modules of the package that are commands, not systems."""

PUBLIC = {
    path.stem
    for path in Path(systems.__path__[0]).glob("*.py")
    if not path.stem.startswith("_") and path.stem not in JOBS
}


def test_every_module_is_collected_under_its_own_name():
    assert set(ENTRIES) == PUBLIC
    for name, entry in ENTRIES.items():
        assert import_module(f"systems.{name}").entry is entry


@pytest.mark.parametrize("name", ENTRIES)
def test_the_docstring_says_what_the_system_is(name):
    entry = ENTRIES[name]
    doc = import_module(f"systems.{name}").__doc__
    assert 'Pila, "Introduction to Lagrangian Dynamics", ch. ' in doc
    assert "\nParameters" in doc
    for word in (*entry.coordinates, *entry.parameter_units):
        assert re.search(rf"\b{word}\b", doc), word
    head, _ = doc.split("\n\nCoordinate")
    assert sum(line.startswith("    ") for line in head.splitlines()) >= 4  # the sketch


@pytest.mark.parametrize("name", ENTRIES)
def test_the_book_place_is_that_of_the_docstring(name):
    doc = " ".join(import_module(f"systems.{name}").__doc__.split())
    entry = ENTRIES[name]
    for figure in re.findall(r"\d\.\d+[a-c]?", entry.book):
        assert figure in doc


OF_EACH_KIND = ("central_motion", "double_pendulum_static_load", "carnival_ride")


@pytest.mark.parametrize(
    "name",
    [
        name if name in OF_EACH_KIND else pytest.param(name, marks=pytest.mark.full)
        for name in ENTRIES
    ],
)
def test_the_example_runs(name, capsys):
    assert main(["run", name]) == 0
    out = capsys.readouterr().out
    assert out.startswith(f"{name}: {ENTRIES[name].book}\n")
    if ENTRIES[name].kind != "prescribed":
        assert re.search(r"^status +ok at ", out, re.MULTILINE)


def test_list_names_every_system_once(capsys):
    assert main(["list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == list(ENTRIES)


def test_an_unknown_name_gets_its_neighbours(capsys):
    with pytest.raises(UnknownSystem, match=r"'duble_pendulum'\. Did you mean double_pendulum"):
        find("duble_pendulum")
    with pytest.raises(UnknownSystem, match=r"'zzz'\. Known: rotating_body_on_frame, disk_"):
        find("zzz")
    assert main(["run", "centralmotion"]) == 1
    assert "Did you mean central_motion" in capsys.readouterr().err


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


def test_an_entry_speaks_of_one_system():
    assert declare().coordinates == ("x",)
    with pytest.raises(ValueError, match=r"free: coordinate_units must have one value for each"):
        declare(coordinate_units=("m", "rad"))
    with pytest.raises(ValueError, match=r"free: example.params must name the parameters k"):
        declare(parameter_units={"k": "N/m"})


@pytest.mark.parametrize("suffix", [".png", ".svg"])
@pytest.mark.parametrize(
    "name", ["cart_pendulum", "sleeve_pendulum_equilibrium", "two_link_robot_arm_inverse"]
)
def test_plot_writes_a_figure(name, suffix, tmp_path, capsys):
    """A motion, a state of rest, a prescribed motion."""
    path = tmp_path / f"figure{suffix}"
    assert main(["run", name, "--plot", str(path)]) == 0
    assert path.stat().st_size > 10_000
    assert str(path) in capsys.readouterr().out


def test_plot_says_why_it_cannot(tmp_path, capsys, monkeypatch):
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
    assert found["p_phi"] < 100 * TOLERANCE  # 100: the local errors of some tens of steps add up
