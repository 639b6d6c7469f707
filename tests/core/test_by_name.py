"""Values by name, and attributes that an object does not have."""

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest

from jaxlag._core._by_name import ByName, no_attribute

VALUES = ByName({"rod": jnp.array([1.0, 2.0]), "cord": jnp.array(3.0)})


def test_a_wrong_name_is_told_the_right_ones():
    message = r"^`name` must be one of \['rod', 'cord'\], but it was 'rods'\. Write 'rod'\.$"
    with pytest.raises(KeyError) as caught:
        VALUES["rods"]
    assert str(caught.value) == message[1:-1].replace("\\", "")
    with pytest.raises(KeyError, match=r"one of \['rod', 'cord'\], but it was 7\.$"):
        VALUES[7]
    assert VALUES.get("rods") is None
    assert "rods" not in VALUES


def test_values_by_name_are_a_pytree_as_dicts_are():
    doubled = jax.jit(lambda x: jax.tree.map(lambda y: 2 * y, x))(VALUES)
    assert type(doubled) is ByName
    plain = jax.tree_util.tree_flatten_with_path(dict(VALUES))[0]
    own = jax.tree_util.tree_flatten_with_path(VALUES)[0]
    assert [jax.tree_util.keystr(path) for path, _ in own] == ["['cord']", "['rod']"]
    assert [path for path, _ in own] == [path for path, _ in plain]
    gradient = jax.grad(lambda x: jnp.sum(x["rod"] ** 2) + x["cord"])(VALUES)
    assert gradient["rod"].tolist() == [2.0, 4.0]


class Owner(eqx.Module):
    size: int

    @property
    def broken(self):
        return self.size.nothing

    def __getattr__(self, name):
        return no_attribute(self, name, {"length": "owner.size"})


def test_attributes_of_other_tools_are_told_ours():
    owner = Owner(3)
    assert owner.size == 3
    with pytest.raises(AttributeError, match=r"'Owner' .* no attribute 'length'. Write owner.size"):
        owner.length  # noqa: B018
    with pytest.raises(AttributeError, match=r"'Owner' object has no attribute 'nothing'$"):
        owner.nothing  # noqa: B018
    assert not hasattr(owner, "nothing")


def test_an_attribute_error_inside_a_property_stays_visible():
    with pytest.raises(AttributeError, match="'int' object has no attribute 'nothing'"):
        Owner(3).broken  # noqa: B018
