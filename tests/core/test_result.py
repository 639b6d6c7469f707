"""A batch of results is a sequence of results."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export

import jaxlag as jl
from jaxlag._core._result import AbstractResult


class Result(AbstractResult):
    x: jax.Array  # (*batch, 2)

    @property
    def batch_shape(self):
        return self.x.shape[:-1]

    def __getitem__(self, index):
        return self._select(index)


FOUR = Result(jnp.arange(8.0).reshape(4, 2))
GRID = Result(jnp.arange(24.0).reshape(3, 4, 2))


def test_batch_has_a_length_and_ends():
    assert len(FOUR) == 4
    assert [np.asarray(r.x).tolist() for r in FOUR] == FOUR.x.tolist()
    assert [r.batch_shape for r in GRID] == [(4,)] * 3
    assert bool(FOUR)
    assert bool(FOUR[0])


@pytest.mark.parametrize("index", [4, -5, (3, 0), (0, 0, 0), np.array([0, 4]), [1, 7], 0.5])
def test_index_beyond_a_batch_is_refused(index):
    batch = GRID if isinstance(index, tuple) else FOUR
    with pytest.raises(IndexError, match=r"`index` must select from a batch of shape \(.*it was"):
        batch[index]


@pytest.mark.parametrize(
    "index",
    [
        1,
        -1,
        slice(1, None),
        ...,
        (..., 2),
        (slice(None), 2),
        (2, 3),
        (None, 1),
        np.array([2, 0]),
        [2, 0],
        [],
        jnp.array([2, 0]),
        (np.array([2, 0]), slice(None, 2)),
        np.array([True, False, True]),
    ],
    ids=str,
)
def test_index_selects_as_for_arrays_of_the_batch(index):
    places = np.arange(12).reshape(3, 4)[index]
    np.testing.assert_array_equal(GRID[index].x, GRID.x.reshape(12, 2)[places])


def test_single_result_is_no_sequence():
    one = FOUR[0]
    with pytest.raises(TypeError, match="a single Result has no length: it is no batch"):
        len(one)
    with pytest.raises(TypeError, match="a single Result"):
        iter(one)
    with pytest.raises(ValueError, match="`index` must belong to a batch, but this is a single"):
        one[0]


def test_names_are_not_members():
    with pytest.raises(TypeError, match="`in` is not supported by Result"):
        "x" in FOUR  # noqa: B015


def test_batch_of_symbolic_size_is_indexed():
    (k,) = export.symbolic_shape("k")
    like = jax.ShapeDtypeStruct((k, 2), FOUR.x.dtype)
    exported = export.export(jax.jit(lambda x: Result(x)[0].x))(like)
    np.testing.assert_array_equal(exported.call(FOUR.x), FOUR.x[0])


def test_traced_index_selects():
    found = jax.jit(lambda k: FOUR[k].x)(2)
    np.testing.assert_array_equal(found, FOUR.x[2])


@pytest.mark.full
def test_motions_equilibria_and_assemblies_are_sequences():
    system = jl.System(lambda t, q, v, p: 0.5 * v[0] ** 2 - 0.5 * p * q[0] ** 2, ("x",))
    starts = jnp.arange(1.0, 4.0)[:, None]
    motions = jax.vmap(
        lambda q: jl.simulate(system, q, [0.0], [0.0, 0.1], 4.0, dt=0.1, method="bosh3")
    )(starts)
    assert [float(m["x"][0]) for m in motions] == [1.0, 2.0, 3.0]
    with pytest.raises(IndexError, match=r"batch of shape \(3,\), but it was 3"):
        motions[3]
    with pytest.raises(IndexError, match="too many indices"):
        motions[0, 1]
    rest = jax.vmap(lambda q: jl.equilibrium(system, q, 4.0))(starts)
    assert [e.q.shape for e in rest] == [(1,)] * 3
    rest[1].message()
    near = jax.vmap(lambda q: jl.assemble(system, q, [0.0], 4.0))(starts)
    assert [float(a.q[0]) for a in near] == [1.0, 2.0, 3.0]
