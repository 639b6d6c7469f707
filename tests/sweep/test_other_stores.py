"""Stores of other sweeps and other folders: refused, or replaced where that is wanted."""

import json
import os
import shutil
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _springs import SPRING, TS, N, draw, files, lagrangian, swept

import jaxlag as jl
from jaxlag._simulation._options._simulate_options import NO_OPTIONS
from jaxlag._sweep import _store
from jaxlag._sweep._digest import digest_of, digest_of_program
from jaxlag._sweep._plan import planned
from jaxlag._sweep._problem import differences, problem_of
from jaxlag._sweep._record import Layout


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "runs.zarr"
    return swept(path), path


def other(t, q, v, p):
    return 0.5 * v[0] ** 2 - 0.6 * p["k"] * q[0] ** 2


FEW = [
    ({"system": jl.System(other, ("x",))}, r"differs in equations \(\w{8}... there"),
    ({"seed": 1}, r"differs in seed \(0 there, 1 here\)"),
    ({"n": 2499}, r"differs in n \(2500 there, 2499 here\). Choose another path, or give over"),
]
MORE = [
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
    (
        {"system": jl.System(lagrangian, ("y",)), "keep": ("y", "energy")},
        r"differs in coordinates \(\['x'\] there, \['y'\] here\), keep",
    ),
]


@pytest.mark.parametrize(
    ("changed", "message"), [*FEW, *(pytest.param(*x, marks=pytest.mark.full) for x in MORE)]
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


def problem(system, **simulate_options):
    options = simulate_options or NO_OPTIONS
    return problem_of(planned(system, draw, 3, TS, 0, ("x",), (), options))


def test_rules_of_custom_derivatives_are_compared():
    """They are in no text of a traced program."""
    one, same, other = (problem(squared(slope)) for slope in (1.0, 1.0, 2.0))
    assert one == same
    assert differences(one, other).startswith("equations (")


def test_the_order_of_options_makes_no_difference():
    one = problem(SPRING, rtol=1e-6, atol=1e-9)
    assert json.dumps(one) == json.dumps(problem(SPRING, atol=1e-9, rtol=1e-6))
    assert differences(one, problem(SPRING, rtol=1e-6)).startswith("simulate_options (")


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


def test_a_sweep_that_was_overwritten_has_no_values(tmp_path):
    """Neither those of the other sweep, nor its statuses."""
    path = tmp_path / "runs.zarr"
    run = swept(path, n=3)
    stored = jl.open_sweep(path)
    swept(path, n=3, seed=1, overwrite=True)
    message = r"`store` must still hold this sweep, but .* was overwritten: seed \(1 there, 0 here"
    for old in (run, stored):
        for read in (lambda x: x["x"], lambda x: x.status, lambda x: x.to_xarray(), repr):
            with pytest.raises(ValueError, match=message):
                read(old)
    with pytest.raises(ValueError, match=message):
        stored.checksum  # noqa: B018


@pytest.mark.parametrize("failing", ["error", "end"])
def test_an_overwrite_that_fails_keeps_the_store(whole, tmp_path, monkeypatch, failing):
    """Also one that is ended before the new store is at its place."""
    path, replace = tmp_path / "runs.zarr", os.replace
    shutil.copytree(whole[1], path)

    class Ended(BaseException):
        pass

    def refused(source, target):
        if str(source).endswith("jaxlag-new"):
            raise OSError(5, "Input/output error") if failing == "error" else Ended
        replace(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", refused)
        if failing == "end":
            patch.setattr(_store, "bring_back", lambda folder: None)
            patch.setattr(shutil, "rmtree", lambda *args, **options: None)
        with pytest.raises(ValueError if failing == "error" else Ended):
            swept(path, seed=1, overwrite=True)
    assert path.exists() == (failing == "error")
    assert swept(path).report.computed == 0
    assert files(path) == files(whole[1])
    assert [x.name for x in tmp_path.iterdir()] == ["runs.zarr"]


def test_other_files_in_a_store_are_kept(whole, tmp_path):
    path = tmp_path / "runs.zarr"
    shutil.copytree(whole[1], path)
    (path / "notes.md").write_text("mine")
    message = r"must hold nothing else to be overwritten, but .* holds \['notes.md'\]. Move these"
    with pytest.raises(ValueError, match=message):
        swept(path, seed=1, overwrite=True)
    assert (path / "notes.md").read_text() == "mine"
    assert swept(path).report.computed == 0


@pytest.mark.parametrize(
    "damaged", ["t/c/0", "x/zarr.json", "status/zarr.json", "t/zarr.json", "checksum/zarr.json"]
)
@pytest.mark.parametrize("content", [None, b"{", b""])
def test_damaged_stores_are_not_read(whole, tmp_path, damaged, content):
    path = tmp_path / "runs.zarr"
    shutil.copytree(whole[1], path)
    (path / damaged).unlink()
    if content is not None:
        (path / damaged).write_bytes(content)
    with pytest.raises(ValueError, match=r"`store` must have whole files, .* The same jl.sweep wr"):
        jl.open_sweep(path)


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
        ({"store": "~nosuchuser/runs"}, "`store` must be the path of a local folder, but '~nosuch"),
        ({"store": "a" * 300}, "`store` must be the path of a local folder, but .* too long"),
        ({"keep": (["x"],)}, r"`keep` must be a sequence of names, but one was \['x'\]"),
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
        (("arm/left", "y"), "`keep` must have names that can be those of folders, .* 'arm/left'"),
        ((".hidden",), "`keep` must have names that can be those of folders"),
    ],
)
def test_names_are_those_of_folders(tmp_path, names, message):
    values = {name: jax.ShapeDtypeStruct((3,), np.dtype(float)) for name in names}
    layout = Layout(1, 1024, TS, values, {})
    with pytest.raises(ValueError, match=message):
        _store.created(tmp_path / "runs.zarr", {}, layout, False)
    assert not list(tmp_path.iterdir())


def test_names_of_what_is_kept_anyway_are_refused():
    system = jl.System(lambda t, q, v, p: 0.5 * (v @ v) - 0.5 * p["k"] * (q @ q), ("status",))
    message = r"`keep` must leave out \['status', .* one was 'status'. Give this coordinate"
    with pytest.raises(ValueError, match=message):
        swept(system=system, keep=("status",))
