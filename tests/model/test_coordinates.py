"""Names and shapes of coordinates, and their flat vector."""

import re

import jax.numpy as jnp
import numpy as np
import pytest
from _user import unchecked  # noqa: F401

from jaxlag._model._coordinates import Coordinates, state_vectors, vector

PLAIN = Coordinates(("x", "theta"))
MIXED = Coordinates({"x": (2, 3), "theta": (), "w": (1,)})


def test_names_shapes_and_labels():
    assert (PLAIN.names, PLAIN.size, PLAIN.labels) == (("x", "theta"), 2, ("x", "theta"))
    assert (MIXED.names, MIXED.size) == (("x", "theta", "w"), 8)
    assert MIXED.labels == (
        *("x[0,0]", "x[0,1]", "x[0,2]", "x[1,0]", "x[1,1]", "x[1,2]"),
        *("theta", "w[0]"),
    )
    assert [MIXED.label(i) for i in (0, 5, 6, 7)] == ["x[0,0]", "x[1,2]", "theta", "w[0]"]
    assert Coordinates(["x", "theta"]) == PLAIN


def test_labels_match_the_order_of_unflatten():
    parts = MIXED.unflatten(jnp.arange(8.0))
    for i, label in enumerate(MIXED.labels):
        name, *index = re.findall(r"\w+", label)
        assert float(parts[name][tuple(map(int, index))]) == i


def test_flatten_inverts_unflatten():
    q = jnp.arange(8.0) / 7
    parts = MIXED.unflatten(q)
    assert {name: part.shape for name, part in parts.items()} == MIXED.shapes
    np.testing.assert_array_equal(MIXED.flatten(parts), q)
    backwards = dict(reversed(parts.items()))
    np.testing.assert_array_equal(MIXED.flatten(backwards), q)


def test_unflatten_keeps_leading_axes():
    states = jnp.arange(48.0).reshape(2, 3, 8)
    parts = MIXED.unflatten(states)
    assert {name: part.shape for name, part in parts.items()} == {
        "x": (2, 3, 2, 3),
        "theta": (2, 3),
        "w": (2, 3, 1),
    }
    np.testing.assert_array_equal(parts["x"][1, 2], MIXED.unflatten(states[1, 2])["x"])


def test_equal_declarations_have_equal_hashes():
    assert Coordinates(("x", "theta")) == PLAIN
    assert hash(Coordinates({"x": (), "theta": ()})) == hash(PLAIN)
    others = [
        ("theta", "x"),
        ("x",),
        {"x": (1,), "theta": ()},
        {"x": (3, 2), "theta": (), "w": (1,)},
    ]
    assert all(Coordinates(other) not in (PLAIN, MIXED) for other in others)
    assert PLAIN != ("x", "theta")


@pytest.mark.parametrize(
    ("declared", "message"),
    [
        ((), "`coordinates` must have at least one name, but it was empty. Write"),
        ({}, "`coordinates` must have at least one name, but it was empty."),
        ("theta", "`coordinates` must be names, or names with shapes, but it was 'theta'. Write"),
        (2, "`coordinates` must be names, or names with shapes, but it was 2."),
        ({"x", "y"}, "`coordinates` must be names, or names with shapes, but it was {"),
        (("x", ""), "`coordinates` must be non-empty strings, but one was ''."),
        (("x", 3), "`coordinates` must be non-empty strings, but one was 3."),
        (("x", "y", "x"), "`coordinates` must be distinct, but 'x' occurs 2 times."),
        ({"x": -3}, "`coordinates['x']` must be a tuple of sizes, but it was -3."),
        ({"x": [3]}, "`coordinates['x']` must be a tuple of sizes, but it was [3]."),
        ({"x": (3, 0)}, "`coordinates['x']` must be a tuple of sizes, but it was (3, 0)."),
        ({"x": (-1,)}, "`coordinates['x']` must be a tuple of sizes, but it was (-1,)."),
        ({"x": (2.0,)}, "`coordinates['x']` must be a tuple of sizes, but it was (2.0,)."),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_invalid_declaration_is_refused(declared, message):
    with pytest.raises(ValueError, match="^" + re.escape(message)):
        Coordinates(declared)


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"x": 1.0}, "`q` must name exactly ['x', 'theta'], but it named ['x']."),
        (
            {"x": 1.0, "theta": 0.0, "phi": 0.0},
            "`q` must name exactly ['x', 'theta'], but it named ['x', 'theta', 'phi'].",
        ),
        ({"x": [1.0], "theta": 0.0}, "`q['x']` must have shape (), but it was (1,)."),
        ({"x": 1.0, "theta": [[0.0]]}, "`q['theta']` must have shape (), but it was (1, 1)."),
    ],
)
def test_invalid_parts_are_refused(parts, message):
    with pytest.raises(ValueError, match="^" + re.escape(message)):
        PLAIN.flatten(parts)
    with pytest.raises(ValueError, match="^" + re.escape(message.replace("q", "v0", 1))):
        vector(PLAIN, "v0", parts)


@pytest.mark.parametrize(
    ("x", "message"),
    [
        (
            [1.0],
            "`q` must have shape (2,), but its shape was (1,). Give one entry for each, ",
        ),
        ([1.0, 2.0, 3.0], "`q` must have shape (2,), but its shape was (3,)."),
        (1.0, "`q` must have shape (2,), but its shape was ()."),
        ([[1.0, 2.0]], "`q` must have shape (2,), but its shape was (1, 2)."),
        (["one", "two"], "`q` must be 2 numbers, but it was ['one', 'two']."),
        (None, "`q` must be 2 numbers, but it was None."),
        ([1.0, [2.0]], "`q` must be 2 numbers, but it was [1.0, [2.0]]."),
        ([1.0, 2.0j], "`q` must be real, but its dtype was complex128."),
    ],
)
def test_invalid_vector_is_refused(x, message):
    with pytest.raises(ValueError, match="^" + re.escape(message)):
        vector(PLAIN, "q", x)
    with pytest.raises(ValueError, match="^" + re.escape(message)):
        state_vectors(PLAIN, x, [0.0, 0.0])


def test_message_states_the_order_of_entries():
    with pytest.raises(ValueError, match=r"in the order \['x\[0,0\]', 'x\[0,1\]', .*'theta'"):
        vector(MIXED, "q0", [1.0])


def test_vectors_are_floating_and_of_one_dtype():
    assert vector(PLAIN, "q", [1, 2]).dtype == jnp.float64
    single = np.array([1.0, 2.0], np.float32)
    assert vector(PLAIN, "q", single).dtype == jnp.float32
    q, v = state_vectors(PLAIN, single, single)
    assert (q.dtype, v.dtype) == (jnp.float32, jnp.float32)
    assert state_vectors(PLAIN, [1.0, 2.0], None)[1] is None
