"""Pickles of the former layout, with all modules in one folder, are refused with advice."""

import pickle
import sys

import pytest

import jaxlag
from jaxlag._core import _old_pickles


@pytest.mark.parametrize(
    "name",
    ["_solution.Solution", "_system.System", "_statics.Equilibrium", "_fit.fit"],
)
def test_a_pickle_of_the_old_layout_is_refused(name):
    module, _, kind = name.rpartition(".")
    old = f"cjaxlag.{module}\n{kind}\n.".encode()
    must = rf"jaxlag\.{module}.* must be a module or a name of this .*keep `motion\.to_dict\(\)`"
    with pytest.raises(ImportError, match=must):
        pickle.loads(old)


def test_present_names_and_other_packages_load_as_usual():
    new = pickle.loads(b"cjaxlag._system._system\nSystem\n.")
    assert new is jaxlag.System
    with pytest.raises(ModuleNotFoundError, match="No module named 'jaxlogs'"):
        pickle.loads(b"cjaxlogs\nSystem\n.")
    assert not hasattr(jaxlag._system, "__wrapped__")
    assert not hasattr(jaxlag, "nothing")


def test_install_adds_one_finder():
    _old_pickles.install()
    finders = [x for x in sys.meta_path if type(x).__module__ == _old_pickles.__name__]
    assert len(finders) == 1
