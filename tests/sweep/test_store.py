"""Stores of sweeps: the same files whatever ends the process; other sweeps are refused."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from _families import mostly_full
from _springs import KEEP, TS, N, files, swept

import jaxlag as jl
from jaxlag._sweep import _files, _store


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A sweep that nothing has ended."""
    path = tmp_path_factory.mktemp("whole") / "runs.zarr"
    return swept(path), path


def test_a_store_holds_what_memory_holds(whole):
    run, path = whole
    memory = swept()
    stored = jl.open_sweep(path)
    assert len(stored) == len(run) == N
    for name in (*KEEP, "status", "where", "last_time", "accepted", "rejected"):
        expected = memory[name] if name in KEEP else getattr(memory, name)
        for other in (run, stored):
            found = other[name] if name in KEEP else getattr(other, name)
            np.testing.assert_array_equal(found, expected)
            assert found.dtype == expected.dtype
    np.testing.assert_array_equal(stored.ts, TS)
    assert run.report.statuses == {"ok": N}
    assert run.report._replace(seconds=0, first_seconds=0) == memory.report._replace(
        seconds=0, first_seconds=0
    )
    np.testing.assert_array_equal(jl.replay(run, 2000)["x"], memory["x"][2000])
    assert stored.message() == f"{N} trajectories: {N} ok"
    assert repr(stored) == f"StoredSweep(x, energy: {N} trajectories, 3 times, {N} ok)"
    with pytest.raises(KeyError, match=r"must be one of \['x', 'energy'\]"):
        stored["y"]


def test_a_dataset_of_a_store_is_lazy(whole):
    run, path = whole
    view = jl.open_sweep(path).to_xarray()
    assert dict(view.sizes) == {"motion": N, "t": 3}
    assert view["x"].chunks == ((1024, 1024, 452), (3,))
    assert view["t"].attrs["units"] == "s"
    assert view["status"].attrs["flag_meanings"].startswith("not_computed ok max_steps ")
    mean = float(view["x"].isel(t=-1).mean())
    np.testing.assert_allclose(mean, run["x"][:, -1].mean(), rtol=1e-13)


def test_a_computed_store_is_not_computed_again(whole):
    run, path = whole
    before = files(path)
    again = swept(path)
    assert again.report.computed == 0
    assert again.report.accepted == run.report.accepted
    assert files(path) == before
    assert jl.open_sweep(path).checksum == jl.open_sweep(path).checksum


def test_own_times_and_arrays(tmp_path):
    ts = np.linspace([0.0, 0.0, 0.0], [1.0, 2.0, 3.0], 4, axis=-1)
    cases = jl.Case(np.ones((3, 1)), np.zeros((3, 1)), {"k": np.array([1.0, 2.0, np.nan])}, ts=ts)
    path = tmp_path / "runs.zarr"
    run = swept(path, cases=cases, n=None, ts=None)
    memory = swept(cases=cases, n=None, ts=None)
    np.testing.assert_array_equal(run.ts, ts)
    np.testing.assert_array_equal(run["x"], memory["x"])
    assert run.report.statuses == {"ok": 2, "nonfinite": 1}
    view = run.to_xarray()
    assert "t" in view.coords
    np.testing.assert_array_equal(view["t"], ts)
    assert view["x"].dims == ("motion", "save")
    other = jl.Case(np.ones((3, 1)), np.zeros((3, 1)), {"k": np.array([1.0, 2.5, np.nan])}, ts=ts)
    with pytest.raises(ValueError, match=r"differs in cases.params \("):
        swept(path, cases=other, n=None, ts=None)


# ---- Ends at any moment --------------------------------------------------------------------------


class Killed(BaseException):
    """In place of the end of the process."""


@pytest.mark.parametrize("seed", mostly_full(range(8), 0, 1))
def test_a_sweep_goes_on_after_any_operation_on_files(whole, tmp_path, monkeypatch, seed):
    """Files that are being written are left as they are, as by the end of the process."""
    path, rng = tmp_path / "runs.zarr", np.random.default_rng(seed)
    ends = 0
    while True:
        left = int(rng.integers(1, 80))

        def operation(function):
            def called(*args):
                nonlocal left
                left -= 1
                if left == 0:
                    raise Killed
                return function(*args)

            return called

        with monkeypatch.context() as patch:
            for name in ("fsync", "replace"):
                patch.setattr(os, name, operation(getattr(os, name)))
            patch.setattr(Path, "unlink", lambda *args, **options: None)
            try:
                swept(path)
                break
            except Killed:
                ends += 1
    assert ends >= 1
    assert swept(path).report.computed == 0
    assert files(path) == files(whole[1])
    assert not list(tmp_path.glob(".*"))


WRITER = """
import json, os, sys, time
import numpy as np, jax
from pathlib import Path
from types import SimpleNamespace
from jaxlag._sweep._record import Layout
from jaxlag._sweep._store import created

def row(*shape, dtype=float):
    return jax.ShapeDtypeStruct(shape, np.dtype(dtype))

facts = {name: row(dtype="int32") for name in ("status", "where", "accepted", "rejected")}
facts["last_time"] = row()
layout = Layout(40_000, 1024, np.linspace(0.0, 1.0, 3), {"x": row(3)}, facts)

def write(path):
    store = created(path, {"n": 40_000, "values": ["x"]}, layout, False)
    with store.writer() as write:
        for block in store.missing():
            rng, within = np.random.default_rng(block), layout.within(block)
            count = within.stop - within.start
            write(block, {name: rng.normal(size=(count, *x.shape)).astype(x.dtype)
                          for name, x in layout.arrays.items()})

path, kills = sys.argv[1], int(sys.argv[2])
write(path + "-whole")
rng, ended = np.random.default_rng(0), 0
for k in range(kills):
    folder = f"{path}-{k}"
    for longest in (0.25, 0.25, 0.25, None):
        child = os.fork()
        if child == 0:
            write(folder)
            os._exit(0)
        if longest is not None:
            time.sleep(rng.uniform(0.0, longest))
            os.kill(child, 9)
        ended += os.waitpid(child, 0)[1] == 9
print(ended)
"""


@pytest.mark.full
def test_a_store_goes_on_after_processes_are_killed(tmp_path):
    """At 210 random moments, three for each store; the files are those of an undisturbed one."""
    run = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", WRITER, str(tmp_path / "runs"), "70"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    assert int(run.stdout) > 100
    expected = files(tmp_path / "runs-whole")
    assert len(expected) == 7 * 40 + 10
    for k in range(70):
        assert files(tmp_path / f"runs-{k}") == expected
    assert not list(tmp_path.glob(".*"))


SWEEP = """
import sys
sys.path.insert(0, {folder!r})
import jax
jax.config.update("jax_enable_x64", True)
import _springs
print("begun", flush=True)
_springs.swept(sys.argv[1], n=30_000)
"""


@pytest.mark.full
def test_a_sweep_goes_on_after_processes_are_killed(tmp_path):
    code = SWEEP.format(folder=str(Path(__file__).parent))
    rng = np.random.default_rng(0)
    path, killed = tmp_path / "runs.zarr", 0
    for k in range(6):
        child = subprocess.Popen(
            [sys.executable, "-c", code, str(path)], stdout=subprocess.PIPE, text=True
        )
        assert child.stdout is not None
        child.stdout.readline()
        if k < 5:
            deadline = time.monotonic() + 120
            while not path.exists() and time.monotonic() < deadline:
                time.sleep(0.01)
            time.sleep(rng.uniform(0.0, 8.0))
            child.send_signal(signal.SIGKILL)
        killed += child.wait() == -signal.SIGKILL
        child.stdout.close()
    assert killed >= 1
    undisturbed = tmp_path / "whole.zarr"
    subprocess.run([sys.executable, "-c", code, str(undisturbed)], check=True, capture_output=True)
    assert files(path) == files(undisturbed)


@pytest.mark.parametrize("damage", ["cut", "changed", "lost", "entry"])
def test_damaged_files_are_computed_again(whole, tmp_path, caplog, damage):
    path = tmp_path / "runs.zarr"
    swept(path)
    file = path / ("checksum/c/1/0" if damage == "entry" else "x/c/1/0")
    content = file.read_bytes()
    if damage == "lost":
        file.unlink()
    else:
        file.write_bytes(content[:100] if damage == "cut" else content[:-1] + b"?")
    again = swept(path)
    assert again.report.computed == 1024
    assert f"Block 1 in {path} was damaged" in caplog.text
    assert files(path) == files(whole[1])


def test_blocks_are_tied_to_their_index(whole, tmp_path):
    """As after a copy that went wrong."""
    path = tmp_path / "runs.zarr"
    shutil.copytree(whole[1], path)
    for array in path.iterdir():
        if (array / "c" / "1").exists():
            shutil.rmtree(array / "c" / "1", ignore_errors=True)
            (array / "c" / "1").unlink(missing_ok=True)
            copy = shutil.copytree if (array / "c" / "0").is_dir() else shutil.copy
            copy(array / "c" / "0", array / "c" / "1")
    assert swept(path).report.computed == 1024
    assert files(path) == files(whole[1])


@pytest.mark.parametrize(("writes", "computed"), [(3, 0), (12, 1024)])
def test_a_full_disk_keeps_what_was_written(whole, tmp_path, monkeypatch, writes, computed):
    """Each block has 8 files."""
    path, left = tmp_path / "runs.zarr", writes

    def synchronized(number):
        nonlocal left
        left -= 1
        if left <= 0:
            raise OSError(28 if left == 0 else 5, "No space left on device" if left == 0 else "No")

    with monkeypatch.context() as patch:
        patch.setattr(_files, "os", SimpleNamespace(fsync=synchronized, replace=os.replace))
        block = computed // 1024
        message = rf"`store` must take block {block} of 3, .* No space left on device. All blocks"
        with pytest.raises(OSError, match=message):
            swept(path)
    assert not list(path.rglob("*.partial"))
    partly = jl.open_sweep(path)
    assert (partly.status >= 0).sum() == computed
    assert np.isnan(partly["x"][computed:]).all()
    assert swept(path).report.computed == N - computed
    assert files(path) == files(whole[1])


@pytest.mark.parametrize("name", ["t/c/0", "x/zarr.json"])
def test_metadata_and_times_are_mended(whole, tmp_path, caplog, name):
    path = tmp_path / "runs.zarr"
    for damage in (lambda file: file.unlink(), lambda file: file.write_bytes(b"?" * 24)):
        shutil.rmtree(path, ignore_errors=True)
        shutil.copytree(whole[1], path)
        damage(path / name)
        assert swept(path).report.computed == 0
        assert "was damaged; it is written again" in caplog.text
        assert files(path) == files(whole[1])


def test_a_block_without_its_digest_has_no_status(whole, tmp_path, monkeypatch):
    """As a reader finds it that comes while the block is written, first or again."""
    path, names = tmp_path / "runs.zarr", []
    shutil.copytree(whole[1], path)
    (path / "x" / "c" / "1" / "0").unlink()
    with pytest.raises(
        ValueError, match=r"must have whole files, but one in .* is not: block 1. The"
    ):
        jl.open_sweep(path)
    write = _store.write_whole

    def read_after(target, content):
        write(target, content)
        names.append(target.relative_to(path).parts[0])
        seen = jl.open_sweep(path)
        computed = seen.status >= 0
        assert computed.sum() == N - 1024 * (names[-1] not in ("status", "checksum"))
        assert np.isfinite(seen["x"][computed]).all()

    monkeypatch.setattr(_store, "write_whole", read_after)
    assert swept(path).report.computed == 1024
    assert names[-2:] == ["status", "checksum"]


def test_a_name_that_ends_as_files_that_are_written(tmp_path):
    system = jl.System(lambda t, q, v, p: 0.5 * (v @ v) - 0.5 * p["k"] * (q @ q), ("a.partial",))
    for _ in range(2):
        run = swept(tmp_path / "runs", system=system, n=2, keep=("a.partial",))
    assert run.report.computed == 0
    assert "a.partial" in run.values
    assert repr(run.values) == "Values(a.partial)"
