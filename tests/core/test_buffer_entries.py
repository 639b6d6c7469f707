"""Entries of buffers at an index of each trajectory's own, without a gather or scatter."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlag._core._batching import LANES
from jaxlag._core._buffer_entries import entry_of, set_entries, set_entry


def numbers(count, dtype=float):
    """(buffers, entries, indices) of some lanes."""
    rng = np.random.default_rng(0)
    buffer = jnp.asarray(rng.integers(0, 9, (count, 5, 2)), dtype)
    entry = jnp.asarray(rng.integers(0, 9, (count, 2)))
    return buffer, entry, jnp.asarray(rng.integers(0, 5, count), jnp.int32)


@pytest.mark.parametrize("lanes", [3, 2 * LANES + 1])
@pytest.mark.parametrize("dtype", [float, np.int32])
def test_set_entry_writes_at_the_index_of_each_lane(lanes, dtype):
    buffer, entry, index = numbers(lanes, dtype)
    right = np.array(buffer)
    right[np.arange(lanes), index] = entry
    each = jax.vmap(set_entry)
    np.testing.assert_array_equal(jax.jit(each)(buffer, index, entry), right)
    same = np.array(buffer)
    same[:, 2] = entry[0]
    several = jax.vmap(set_entry, (0, None, None))(buffer, jnp.asarray(2), entry[0])
    np.testing.assert_array_equal(several, same)
    assert several.dtype == dtype
    # Directions within trajectories, and trajectories within directions.
    once, twice = jax.vmap(set_entry, (0, None, 0)), jnp.stack([buffer, 2 * buffer], 1)
    found = jax.jit(jax.vmap(once))(twice, index, jnp.stack([entry, 2 * entry], 1))
    np.testing.assert_array_equal(found, np.stack([right, 2 * right], 1))
    found = jax.jit(jax.vmap(each, (1, None, 1)))(twice, index, jnp.stack([entry, 2 * entry], 1))
    np.testing.assert_array_equal(found, np.stack([right, 2 * right]))
    if dtype is float:  # linear in the buffer and the entry
        entry = entry.astype(dtype)
        dots = jax.jvp(lambda b, r: each(b, index, r), (buffer, entry), (-buffer, -entry))
        np.testing.assert_array_equal(dots[1], -right)


@pytest.mark.parametrize("lanes", [3, 2 * LANES + 1])
@pytest.mark.parametrize("dtype", [float, np.int32])
def test_entry_of_reads_at_the_index_of_each_lane(lanes, dtype):
    buffer, _, index = numbers(lanes, dtype)
    right = np.asarray(buffer)[np.arange(lanes), index]
    each = jax.vmap(entry_of)
    np.testing.assert_array_equal(jax.jit(each)(buffer, index), right)
    shared = jax.jit(jax.vmap(entry_of, (None, 0)))(buffer[0], index)
    np.testing.assert_array_equal(shared, np.asarray(buffer[0])[index])
    np.testing.assert_array_equal(
        jax.vmap(entry_of, (0, None))(buffer, jnp.asarray(2)), buffer[:, 2]
    )
    numbers_alone = each({"x": buffer[..., 0]}, index)["x"]
    np.testing.assert_array_equal(numbers_alone, right[:, 0])
    twice = jnp.stack([buffer, 2 * buffer], 1)
    found = jax.jit(jax.vmap(jax.vmap(entry_of, (0, None))))(twice, index)
    np.testing.assert_array_equal(found, np.stack([right, 2 * right], 1))
    found = jax.jit(jax.vmap(each, (1, None)))(twice, index)
    np.testing.assert_array_equal(found, np.stack([right, 2 * right]))
    if dtype is float:
        dots = jax.jvp(lambda b: each(b, index), (buffer,), (-buffer,))
        np.testing.assert_array_equal(dots[1], -right)


def test_set_entries_writes_into_given_rows_one_after_another():
    """The last of several writes into one place stays; inactive ones do nothing, of any row."""
    buffer, entry, index = numbers(4)
    rows, active = jnp.array([2, 0, 2, 9]), jnp.array([True, True, True, False])
    right = np.array(buffer)
    for row, k, value in list(zip(rows, index, entry, strict=True))[:3]:
        right[row, k] = value
    given = buffer, rows, index, entry.astype(float), active
    np.testing.assert_array_equal(jax.jit(set_entries)(*given), right)
