"""Runs beyond the bounds on memory maps and memory fail and name the test; others pass."""

import mmap
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from _footprint import resident_bytes

CONFTEST = """
from _footprint import Footprint


def pytest_configure(config):
    config.pluginmanager.register(Footprint(most_maps={maps}, most_bytes={size}))
"""
TESTS = """
import mmap

import pytest


def test_few():
    pass


@pytest.fixture(scope="module")
def mappings():
    mappings = []
    yield mappings
    for mapping in mappings:
        mapping.close()


def test_many(mappings):
    mappings += [mmap.mmap(-1, mmap.PAGESIZE) for _ in range(3000)]
"""


def run(folder, workers, maps=20_000, size=4e9):
    """Exit status and output of the two tests above under these bounds."""
    (folder / "conftest.py").write_text(CONFTEST.format(maps=maps, size=size))
    (folder / "test_maps.py").write_text(TESTS)
    env = os.environ | {"PYTHONPATH": str(Path(__file__).parent), "PYTEST_ADDOPTS": ""}
    command = [sys.executable, "-m", "pytest", "-q", "-n", str(workers), str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, env=env, cwd=folder)
    return done.returncode, done.stdout


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="maps are not told here")
@pytest.mark.parametrize("workers", [0, 2])
def test_run_with_too_many_maps_fails_and_names_the_test(tmp_path, workers):
    status, output = run(tmp_path, workers, maps=2500)
    assert status == 1
    assert "2 passed" in output
    (line,) = re.findall(r"^.*TOO MUCH.*$", output, re.MULTILINE)
    assert re.search(r"3\d\d\d memory maps \(bound 2500, most after .*::test_many\)", line)


def test_run_with_too_much_memory_fails(tmp_path):
    status, output = run(tmp_path, 1, size=1e6)
    assert status == 1
    assert "GB (bound 0.0)  TOO MUCH" in output


def test_every_worker_reports_and_a_run_within_the_bounds_passes(tmp_path):
    status, output = run(tmp_path, 2)
    assert status == 0
    assert re.findall(r"^(gw\d): \d+ memory maps", output, re.MULTILINE) == ["gw0", "gw1"]
    assert "TOO MUCH" not in output


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="memory is not told here")
def test_memory_is_current():
    size = 64 << 20
    before = resident_bytes()
    # Pages of the system itself: an allocator may keep what is freed.
    with mmap.mmap(-1, size) as pages:
        pages.write(b"x" * size)
        full = resident_bytes()
    after = resident_bytes()
    assert full - before > 60e6
    assert full - after > 60e6
