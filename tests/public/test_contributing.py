"""The worked examples of CONTRIBUTING.md run; names and tables of both documents are right."""

import importlib
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import test_layers
from _code_blocks import blocks, run

import jaxlag as jl
from bench import stability
from bench.stability import _extremes
from jaxlag._model import _forces
from jaxlag._simulation._methods import METHODS
from systems import catalogue
from systems.__main__ import main
from systems.catalogue import classics
from tests.solvers import test_methods_alone
from tests.systems import test_catalogue

ROOT = Path(__file__).parents[2]
CONTRIBUTING, ARCHITECTURE = ROOT / "CONTRIBUTING.md", ROOT / "ARCHITECTURE.md"
BOTH = pytest.mark.parametrize("path", [CONTRIBUTING, ARCHITECTURE], ids=lambda path: path.stem)
EPS = np.finfo(float).eps


def example(heading):
    """(line, language, text) of the blocks below a heading."""
    lines = CONTRIBUTING.read_text().splitlines()
    start = lines.index(f"### {heading}") + 1
    later = [n for n, line in enumerate(lines, 1) if n > start and line.startswith("### ")]
    return [block for block in blocks(CONTRIBUTING) if start < block[0] < [*later, 1e9][0]]


def follow(found, namespace=None):
    """The names that blocks define; their output is compared with the text blocks."""
    namespace = {} if namespace is None else namespace
    run("CONTRIBUTING.md", found, namespace)
    return namespace


def run_tests(namespace):
    tests = [name for name in namespace if name.startswith("test_")]
    for name in tests:
        namespace[name]()
    return len(tests)


@pytest.fixture
def added(tmp_path, monkeypatch):
    """A function that adds a module to a package, for one test."""

    def add(package, name, text):
        (tmp_path / f"{name}.py").write_text(text)
        monkeypatch.setattr(package, "__path__", [*package.__path__, str(tmp_path)])
        importlib.invalidate_caches()
        module = importlib.import_module(f"{package.__name__}.{name}")
        made.append((package, name, module))
        return module

    made = []
    yield add
    for package, name, module in made:
        del sys.modules[module.__name__]
        delattr(package, name)


# ---- The examples ------------------------------------------------------------------------------


def test_a_system_is_found_by_its_name(added, monkeypatch, capsys):
    (_, _, text), by_hand = example("A system of the catalogue")
    name = "bead_on_hoop"
    module = added(classics, name, text)
    monkeypatch.setitem(catalogue._PACKAGES, name, classics.__name__)
    monkeypatch.setitem(test_catalogue.MODULES, name, module)
    assert catalogue.find(name) is module.entry
    test_catalogue.test_every_module_is_collected_under_its_own_name()
    test_catalogue.test_docstring_describes_the_system(name)
    test_catalogue.test_docstring_contains_the_place_in_the_book(name)
    assert main(["run", name]) == 0
    assert "status   ok" in capsys.readouterr().out
    assert_equal_to_hand_equations(module.entry, follow([by_hand])[name])


def assert_equal_to_hand_equations(entry, by_hand):
    """To 32 roundings of the terms: of a few operations, and of sines on both sides."""
    for t, angle, rate in np.random.default_rng(0).uniform(-1.0, 1.0, (8, 3)):
        q, v, params = np.array([angle]), np.array([rate]), entry.example.params
        M, terms = by_hand(t, q, v, **params)
        expected = np.linalg.solve(M, np.sum(terms, axis=0))
        found = entry.system.acceleration(q, v, params, t=t)
        np.testing.assert_allclose(found, expected, rtol=0, atol=32 * EPS * np.sum(np.abs(terms)))


def test_force_law_has_the_stated_power(monkeypatch):
    law, use, output, tests = example("A force law")
    made = follow([law], dict(vars(_forces)))["PointDamper"]
    monkeypatch.setattr(jl, "PointDamper", made, raising=False)
    namespace = follow([use, output, tests])
    assert run_tests(namespace) == 2
    motion = namespace["motion"]
    # 1e-9 per step for the energy and for the work, over some dozen steps.
    change = motion.energy[-1] - motion.energy[0]
    np.testing.assert_allclose(motion.work["damper"][-1], change, rtol=0, atol=1e-7)
    assert change < -0.1


def test_a_solver_has_its_order(added, monkeypatch):
    (_, _, text), slope = example("A solver")
    solvers = jl.solvers
    module = added(solvers, "_sofroniou4", text)
    monkeypatch.setattr(solvers, "Sofroniou4", module.Sofroniou4, raising=False)
    monkeypatch.setitem(METHODS, "sofroniou4", module.Sofroniou4)
    assert run_tests(follow([slope])) == 1
    solver = module.Sofroniou4()
    test_methods_alone.test_tableaus_satisfy_the_conditions_of_their_order_and_no_more(solver)
    test_methods_alone.test_a_step_is_that_of_the_same_method_of_diffrax(solver, looped=False)


def test_benchmark_case_runs_within_its_bound():
    cases = _extremes.Cases()
    follow(example("A case of a benchmark"), vars(_extremes) | {"cases": cases})
    (case,) = cases.cases
    assert case.name not in {other.name for other in stability.CASES}
    assert stability.judged(case, quick=True)["verdict"] == "within"


def test_modules_of_the_examples_import_only_allowed_packages(tmp_path):
    (_, _, solver), _ = example("A solver")
    path = tmp_path / "_sofroniou4.py"
    path.write_text(solver)
    packages = {module.split(".")[1] for _, module in test_layers.imported(path)}
    assert packages <= {"solvers", *test_layers.ALLOWED["solvers"]}


# ---- Names in both documents -------------------------------------------------------------------


def quoted(path):
    """Text in back-ticks, outside of code blocks."""
    return re.findall(r"`([^`]+)`", re.sub(r"```.*?```", "", path.read_text(), flags=re.DOTALL))


NEW = {"bead_on_hoop.py", "_sofroniou4.py", "_name.py"}
"""Files that the examples create, and the pattern of names."""


@BOTH
def test_every_file_named_exists(path):
    kinds = r"[\w./-]+(/|\.(py|md|toml|json|ipynb))|\.?\w+(/\w+)+"
    found = {name for name in quoted(path) if re.fullmatch(kinds, name)} - NEW
    assert len(found) >= 4
    for name in found:
        assert (ROOT / name).exists(), name


def test_every_file_of_a_command_exists():
    found = re.findall(r"^pytest .*?(\S+\.py)::(\w+)$", CONTRIBUTING.read_text(), re.MULTILINE)
    assert found
    for file, name in found:
        assert f"def {name}(" in (ROOT / file).read_text()


@BOTH
def test_every_name_of_a_module_exists(path):
    packages = "|".join(test_layers.ALLOWED)
    found = [name for name in quoted(path) if re.fullmatch(rf"({packages})(\.\w+)+", name)]
    assert found
    for name in found:
        parts, thing = name.split("."), jl
        for i, part in enumerate(parts, 1):
            if not hasattr(thing, part):
                importlib.import_module(f"jaxlag.{'.'.join(parts[:i])}")
            thing = getattr(thing, part)


def test_table_of_packages_equals_that_of_the_test():
    text = ARCHITECTURE.read_text()
    base, to_system = test_layers._BASE, test_layers._TO_SYSTEM
    groups = {"*base*": base, "*to system*": to_system}
    found = {}
    for name, allowed in re.findall(r"^\| `(\w+)` \| .* \|(.*)\|$", text, re.MULTILINE):
        packages = re.findall(r"\*[\w ]+\*|\w+", allowed)
        found[name] = {part for package in packages for part in groups.get(package, (package,))}
    assert found == {name: set(allowed) for name, allowed in test_layers.ALLOWED.items()}


def test_reserved_names_of_packages_are_free():
    part = ARCHITECTURE.read_text().split("## Where a new capability goes")[1]
    names = re.findall(r"^- `(\w+)`, above", part, re.MULTILINE)
    assert len(names) == 3
    assert not set(names) & {path.stem for path in Path(jl.__file__).parent.iterdir()}


def test_set_up_lines_equal_those_of_the_readme():
    lines = re.findall(r"^pip install -e .*$", CONTRIBUTING.read_text(), re.MULTILINE)
    assert lines == re.findall(r"^pip install -e .*$", (ROOT / "README.md").read_text(), re.M)
