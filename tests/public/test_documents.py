"""Every documented line runs: code and output of the README, doctests, set-up lines."""

import doctest
import importlib
import pkgutil
import re
import tomllib
from pathlib import Path

import pytest
from _code_blocks import blocks, run
from _families import mostly_full

import jaxlag

ROOT = Path(__file__).parents[2]
README = ROOT / "README.md"


def numbers(text):
    return [float(x) for x in re.findall(r"-?\d+\.\d+", text)]


FIRST = 4
"""Blocks of the README's opening example: a program and its output, twice."""


@pytest.mark.parametrize("count", mostly_full([FIRST, None], FIRST), ids=["first", "all"])
def test_readme_prints_the_stated_output(count):
    shown = blocks(README)[:count]
    outputs = sum(language == "text" for _, language, _ in shown)
    assert outputs >= 2
    assert run("README.md", shown, {}) == outputs


def test_readme_shows_the_same_numbers_twice():
    """The simulated and the closed-form values, to the digits shown."""
    shown = [numbers(text) for _, language, text in blocks(README) if language == "text"]
    assert len(shown[0]) == 2
    assert shown[0] == pytest.approx(shown[1], abs=2e-6)


def test_first_program_is_short():
    first = next(text for _, language, text in blocks(README) if language == "python")
    assert sum(bool(line.strip()) for line in first.splitlines()) <= 15


def test_readme_has_two_set_up_lines():
    lines = re.findall(r"^pip install -e .*$", README.read_text(), re.MULTILINE)
    assert lines == [
        'pip install -e ".[plot]" && python -m systems fit-pendulum',
        'pip install -e ".[test]" && pytest',
    ]


def modules():
    names = [jaxlag.__name__]
    names += [m.name for m in pkgutil.walk_packages(jaxlag.__path__, "jaxlag.")]
    return [importlib.import_module(name) for name in names]


EXAMPLES = {
    module.__name__: module
    for module in modules()
    if any(found.examples for found in doctest.DocTestFinder().find(module))
}


FEW = "jaxlag._simulation._simulate", "jaxlag._statics._inverse_dynamics"


def test_there_are_doctests():
    assert {*FEW, "jaxlag._statics._equilibrium"} <= EXAMPLES.keys()


@pytest.mark.parametrize("name", mostly_full(EXAMPLES, *FEW))
def test_doctests_pass(name):
    result = doctest.testmod(EXAMPLES[name])
    assert result.failed == 0
    assert result.attempted > 0


def test_every_public_name_has_a_docstring():
    for name, thing in vars(jaxlag).items():
        if not name.startswith("_") and callable(thing):
            assert thing.__doc__, name


def test_version_and_extras_agree():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert jaxlag.__version__ == project["version"]
    assert project["version"] in (ROOT / "CHANGELOG.md").read_text()
    assert {"plot", "test"} <= set(project["optional-dependencies"])


@pytest.mark.parametrize("name", ["energy", "math", "rotation"])
def test_every_public_function_has_a_docstring(name):
    module = importlib.import_module(f"jaxlag.{name}")
    public = {
        label: thing
        for label, thing in vars(module).items()
        if not label.startswith("_") and getattr(thing, "__module__", None) == module.__name__
    }
    assert len(public) >= 5
    for label, thing in public.items():
        assert thing.__doc__, label
