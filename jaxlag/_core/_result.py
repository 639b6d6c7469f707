"""Results of single problems and of batches: a batch is a sequence of results."""

from abc import abstractmethod
from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import numpy as np

from jaxlag._core._arrays import concrete
from jaxlag._core._errors import invalid, requirement, unsupported


class AbstractResult(eqx.Module):
    """A result whose arrays may have leading axes, as under `jax.vmap`: then it is a batch."""

    @property
    @abstractmethod
    def batch_shape(self) -> tuple[int, ...]:
        """Shape of the leading axes, () for a single result."""

    def __len__(self) -> int:
        """Number of results along the first axis of a batch.

        Raises:
            TypeError: it is a single result.
        """
        if not self.batch_shape:
            raise TypeError(f"a single {type(self).__name__} has no length: it is no batch")
        return self.batch_shape[0]

    def __bool__(self) -> bool:
        return True  # as objects without a length

    def __iter__(self) -> Iterator[Any]:
        """The results of a batch, one after the other.

        Raises:
            TypeError: it is a single result.
        """
        return (self._select(i) for i in range(len(self)))

    def __contains__(self, name: object) -> bool:
        """Names are those of the system."""
        raise TypeError(f"`in` is not supported by {type(self).__name__}: see system.coordinates")

    def require_single(self, what: str) -> None:
        """Refuse `what` for a batch.

        Raises:
            ValueError: it is a batch.
        """
        if self.batch_shape:
            reason, fix = f"its shape is {self.batch_shape}", "Take one of them, as batch[3]."
            raise unsupported(f"`{what}` of a batch", reason, fix)

    def _select(self, index: Any) -> Any:
        """Results of a batch, by an index of its leading axes as for arrays.

        Raises:
            IndexError: an index beyond its axes.
            ValueError: it is a single result.
        """
        batch, kind = self.batch_shape, type(self).__name__
        if not batch:
            raise invalid("index", "belong to a batch", f"this is a single {kind}")
        key = index if isinstance(index, tuple) else (index,)
        if concrete(*key) and all(isinstance(n, int) for n in batch):  # others are symbols
            key = tuple(_indices(x) if isinstance(x, jax.Array | list) else x for x in key)
            try:
                np.broadcast_to(0, batch)[key]
            except IndexError as error:
                must, was = f"select from a batch of shape {batch}", f"it was {index!r}"
                raise IndexError(requirement("index", must, was, f"{error}.")) from None

        spread = any(x is Ellipsis for x in key)

        def selected(x: Any) -> Any:
            """With an ellipsis, which stands for axes of the batch alone."""
            rest = (slice(None),) * (x.ndim - len(batch)) if spread else ()
            return x[(*key, *rest)]

        return jax.tree.map(selected, self)


def _indices(x: Any) -> np.ndarray:
    """As an array of indices, if it is empty, too."""
    return np.asarray(x) if np.size(x) else np.zeros(np.shape(x), int)
