"""Stores of sweeps: the same files whatever ends the process; other sweeps are refused."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxlag as jl
from jaxlag._sweep import _files, _store
from jaxlag._sweep._digest import digest_of, digest_of_program

TS = np.linspace(0.0, 1.0, 3)
N = 2500
KEEP = ("x", "energy")


def lagrangian(t, q, v, p):
    return 0.5 * v[0] ** 2 - 0.5 * p["k"] * q[0] ** 2


SPRING = jl.System(lagrangian, ("x",))


def draw(key, index):
    return jl.Case([1.0], [0.0], {"k": jnp.exp(jax.random.normal(key))})


def swept(store=None, **changed):
    given = {"system": SPRING, "cases": draw, "n": N, "ts": TS, "keep": KEEP, "store": store}
    return jl.sweep(**(given | changed))


def files(folder):
    """Contents of all files."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in Path(folder).rglob("*")
        if path.is_file()
    }


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


@pytest.mark.parametrize("seed", range(8))
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
import test_store
print("begun", flush=True)
test_store.swept(sys.argv[1], n=30_000)
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


@pytest.mark.parametrize(("writes", "computed"), [(3, 0), (12, 1024)])
def test_a_full_disk_keeps_what_was_written(whole, tmp_path, monkeypatch, writes, computed):
    """Each block has 8 files."""
    path, left = tmp_path / "runs.zarr", writes

    def synchronized(number):
        nonlocal left
        left -= 1
        if left <= 0:
            raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(_files, "os", SimpleNamespace(fsync=synchronized, replace=os.replace))
        message = r"`store` must take block \d of 3, .* No space left on device. All blocks"
        with pytest.raises(OSError, match=message):
            swept(path)
    assert not list(path.rglob("*.partial"))
    partly = jl.open_sweep(path)
    assert (partly.status >= 0).sum() == computed
    assert np.isnan(partly["x"][computed:]).all()
    assert swept(path).report.computed == N - computed
    assert files(path) == files(whole[1])


# ---- Other sweeps, and other folders -------------------------------------------------------------


def other(t, q, v, p):
    return 0.5 * v[0] ** 2 - 0.6 * p["k"] * q[0] ** 2


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"seed": 1}, r"differs in seed \(0 there, 1 here\)"),
        ({"n": 2499}, r"differs in n \(2500 there, 2499 here\). Choose another path, or give over"),
        ({"ts": 2 * TS}, r"differs in ts \(3 from 0 to 1, \w{8}... there, 3 from 0 to 2, \w{8}"),
        ({"keep": ("x",)}, r"differs in keep \(\['x', 'energy'\] there, \['x'\] here\)"),
        (
            {"simulate_options": {"rtol": 1e-6}},
            r"differs in simulate_options \({} there, {'rtol': '1e-06'} here\)",
        ),
        (
            {"cases": lambda key, i: jl.Case([1.0], [0.0], {"k": 1.0 + jax.random.normal(key)})},
            r"differs in cases \(\w{8}... there, \w{8}... here\)",
        ),
        ({"system": jl.System(other, ("x",))}, r"differs in equations \(\w{8}... there"),
        (
            {"system": jl.System(lagrangian, ("y",)), "keep": ("y", "energy")},
            r"differs in coordinates \(\['x'\] there, \['y'\] here\), keep",
        ),
    ],
)
def test_other_sweeps_are_refused(whole, changed, message):
    before = files(whole[1])
    with pytest.raises(
        ValueError, match="`store` must hold trajectories of this sweep, .*" + message
    ):
        swept(whole[1], **changed)
    assert files(whole[1]) == before


def squared(slope):
    """x^2 / 2, with a derivative of its own."""

    @jax.custom_vjp
    def function(x):
        return 0.5 * x * x

    function.defvjp(lambda x: (0.5 * x * x, x), lambda x, bar: (slope * x * bar,))
    return jl.System(lambda t, q, v, p: 0.5 * v[0] ** 2 - p["k"] * function(q[0]), ("x",))


def test_rules_of_custom_derivatives_are_compared(tmp_path):
    """They are in no text of a traced program."""
    path = tmp_path / "runs.zarr"
    swept(path, system=squared(1.0), n=3)
    assert swept(path, system=squared(1.0), n=3).report.computed == 0
    with pytest.raises(ValueError, match=r"differs in equations \("):
        swept(path, system=squared(2.0), n=3)


def test_systems_that_call_python_are_refused(tmp_path):
    def drag(t, q, v, p):
        shape = jax.ShapeDtypeStruct((1,), jnp.dtype(float))
        return jax.pure_callback(lambda v: -v, shape, v, vmap_method="expand_dims")

    system = jl.System(lagrangian, ("x",), forces=(jl.GeneralizedForce(drag, "drag"),))
    with pytest.raises(ValueError, match="`system` must be computed by JAX alone in a sweep with"):
        swept(tmp_path / "runs.zarr", system=system, n=3)
    assert not list(tmp_path.iterdir())


def test_digests_have_no_colours(monkeypatch):
    program = jax.make_jaxpr(lambda x: jnp.sin(x) + jnp.arange(3.0))(1.0)
    plain = digest_of_program(program)
    monkeypatch.setattr("jax._src.pretty_printer.CAN_USE_COLOR", True)
    assert "\x1b" in str(program)
    assert digest_of_program(program) == plain
    assert digest_of("", {"b", "a"}) == digest_of("", {"a", "b"})
    other = jax.make_jaxpr(lambda x: jnp.sin(x) + jnp.array([0.0, 1.0, 3.0]))(1.0)
    assert digest_of_program(other) != plain


def test_another_version_is_refused(whole, tmp_path):
    path = tmp_path / "runs.zarr"
    shutil.copytree(whole[1], path)
    metadata = json.loads((path / "zarr.json").read_text())
    metadata["attributes"]["jaxlag"]["problem"]["version of jax"] = "0.1"
    (path / "zarr.json").write_text(json.dumps(metadata))
    with pytest.raises(ValueError, match=r"differs in version of jax \(0.1 there, "):
        swept(path)


def test_a_store_is_overwritten(whole, tmp_path):
    path = tmp_path / "runs.zarr"
    swept(path, seed=7)
    assert swept(path, overwrite=True).report.computed == N
    assert files(path) == files(whole[1])


def test_a_store_of_the_same_sweep_is_not_overwritten(whole, tmp_path):
    path = tmp_path / "runs.zarr"
    shutil.copytree(whole[1], path)
    (path / "checksum" / "c" / "1" / "0").unlink()
    assert swept(path, overwrite=True).report.computed == 1024
    assert files(path) == files(whole[1])


def test_nothing_is_removed_without_zarr(whole, tmp_path, monkeypatch):
    path = tmp_path / "runs.zarr"
    shutil.copytree(whole[1], path)
    monkeypatch.setitem(sys.modules, "zarr", None)
    with pytest.raises(ValueError, match=r"`store` is not supported: zarr is not installed. pip"):
        swept(path, seed=1, overwrite=True)
    assert files(path) == files(whole[1])


def test_folders_beside_a_store_are_kept(tmp_path):
    for name in (".runs.zarr.old", ".runs.zarr.new", "other"):
        (tmp_path / name).mkdir()
    swept(tmp_path / "runs.zarr", n=1)
    swept(tmp_path / "runs.zarr", n=2, overwrite=True)
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {".runs.zarr.old", ".runs.zarr.new", "other", "runs.zarr"}


def test_a_link_stays_a_link(tmp_path):
    (tmp_path / "disk").mkdir()
    link = tmp_path / "runs.zarr"
    link.symlink_to(tmp_path / "disk")
    swept(link, n=1)
    swept(link, n=2, overwrite=True)
    assert link.is_symlink()
    assert len(jl.open_sweep(tmp_path / "disk")) == 2


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
    with pytest.raises(ValueError, match=r"must have whole files, but those of block 1 in .* are"):
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


@pytest.mark.parametrize(
    "content", ["[]", '{"attributes": null}', '{"attributes": {"jaxlag": {"format": 2}}}', "{"]
)
def test_other_metadata_is_no_store(tmp_path, content):
    (tmp_path / "zarr.json").write_text(content)
    for action in (swept, jl.open_sweep, lambda path: swept(path, overwrite=True)):
        with pytest.raises(ValueError, match=r"`store` must be a store of jl.sweep of format 1"):
            action(tmp_path)
    assert (tmp_path / "zarr.json").read_text() == content


def test_a_folder_that_is_none_is_kept(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    for overwrite in (False, True):
        with pytest.raises(
            ValueError, match=r"must be a store of jl.sweep of format 1, but .* is none"
        ):
            swept(tmp_path, overwrite=overwrite)
        with pytest.raises(
            ValueError, match=r"must be a store of jl.sweep of format 1, but .* is none"
        ):
            swept(tmp_path / "notes.txt", overwrite=overwrite)
    assert files(tmp_path) == {"notes.txt": b"mine"}
    with pytest.raises(ValueError, match=r"must be a store of jl.sweep"):
        jl.open_sweep(tmp_path / "absent.zarr")


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"store": 3}, "`store` must be the path of a local folder, but it was 3"),
        ({"store": "s3://bucket/runs"}, "`store` must be the path of a local folder"),
        ({"store": "/proc/runs.zarr"}, "`store` must be a folder that can be written, but /proc"),
        ({"store": "/"}, "`store` must be the path of a local folder, but it was '/'"),
        ({"store": "a\0b"}, "`store` must be the path of a local folder"),
        ({"overwrite": 1}, "`overwrite` must be True or False, but it was 1"),
    ],
)
def test_bad_arguments_are_named(changed, message):
    with pytest.raises(ValueError, match=message):
        swept(**changed)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (("a", "A"), "'A' and 'a' are both names of arrays in a store"),
        (("t", "y"), "'t' and 't' are both names of arrays in a store"),
        (("arm/left", "y"), "`keep` must have names that can be those of folders"),
        (("status", "y"), r"`keep` must leave out \['status', .* one was 'status'. Give this"),
    ],
)
def test_names_are_those_of_folders(tmp_path, names, message):
    system = jl.System(lambda t, q, v, p: 0.5 * (v @ v) - 0.5 * p["k"] * (q @ q), names)
    cases = jl.Case(np.ones((2, 2)), np.zeros(2), {"k": 1.0})
    with pytest.raises(ValueError, match=message):
        swept(tmp_path / "runs", system=system, cases=cases, n=None, keep=names)


def test_a_name_that_ends_as_files_that_are_written(tmp_path):
    system = jl.System(lambda t, q, v, p: 0.5 * (v @ v) - 0.5 * p["k"] * (q @ q), ("a.partial",))
    for _ in range(2):
        run = swept(tmp_path / "runs", system=system, n=2, keep=("a.partial",))
    assert run.report.computed == 0
    assert "a.partial" in run.values
    assert repr(run.values) == "Values(a.partial)"
