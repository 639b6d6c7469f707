"""Values of the inputs at one state, for the forces."""

from collections.abc import Iterator, Mapping
from typing import Any

from jaxlag._core._errors import invalid


class InputValues(Mapping[str, Any]):
    """Values of the inputs by name; remembers which names were read."""

    def __init__(self, values: Mapping[str, Any]) -> None:
        self._values = dict(values)
        self.read: set[str] = set()

    def __getitem__(self, name: str) -> Any:
        if name not in self._values:
            raise invalid(
                "inputs",
                f"have an entry {name!r}, which a declared function reads",
                f"its names were {sorted(self)}",
                "Pass inputs={...} with this name.",
            )
        self.read.add(name)
        return self._values[name]

    def __contains__(self, name: object) -> bool:
        return name in self._values

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def changed(self, values: Mapping[str, Any]) -> "InputValues":
        """The same with these values; both remember what is read of either."""
        found = InputValues(self._values | dict(values))
        found.read = self.read
        return found

    def peek(self) -> dict[str, Any]:
        """All values; none of them counts as read."""
        return dict(self._values)

    def get(self, name: str, default: Any = None) -> Any:
        """The value, or `default` if there is no such input."""
        if name not in self:
            return default
        return self[name]
