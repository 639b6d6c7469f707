"""Outputs of linearized equations: quantities by name, and functions."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxlag._core._errors import invalid
from jaxlag._model._coordinates import Coordinates
from jaxlag._system._system import System
from jaxlag._tracing._signature import real_array, require_arity
from jaxlag._tracing._traced_function import traced_function


class Output(NamedTuple):
    """One output.

    Attributes:
        name: as given.
        kind: "q", "v", "u", "x" or "lam" for entries of these; "function".
        places: indices of the entries.
        labels: of the entries.
        function: of (t, q, v, params).
    """

    name: str
    kind: str
    places: tuple[int, ...] = ()
    labels: tuple[str, ...] = ()
    function: Any = None


class Values(NamedTuple):
    """Quantities of one state that outputs read; u and x of length 0 if there are none."""

    q: Float[Array, " n"]
    v: Float[Array, " n"]
    u: Float[Array, " k"]
    x: Float[Array, " s"]
    lam: Float[Array, " m"]


class Outputs(NamedTuple):
    """All outputs, in order.

    Attributes:
        each: of them.
    """

    each: tuple[Output, ...]

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of all entries."""
        return tuple(label for output in self.each for label in output.labels)

    def reads(self, kind: str) -> bool:
        """Whether any of them is of this kind."""
        return any(output.kind == kind for output in self.each)

    def of(self, values: Values, t: Array, params: Any) -> Float[Array, " r"]:
        """Their entries."""
        found = [jnp.zeros((0,), values.q.dtype)]
        for output in self.each:
            if output.kind == "function":
                y = output.function(t, values.q, values.v, params)
                found.append(jnp.asarray(y).reshape(-1).astype(values.q.dtype))
            else:
                found.append(getattr(values, output.kind)[np.array(output.places, int)])
        return jnp.concatenate(found)


def outputs_of(system: System, outputs: Any, rows: Sequence[str], state: tuple) -> Outputs:
    """The declared outputs.

    Args:
        system: the mechanical system.
        outputs: names and functions, or a dict from names to these.
        rows: labels of the constraint rows.
        state: (t, q, v, params); shapes and dtypes are used.

    Raises:
        ValueError: an unknown name or one of two quantities, something that is neither a name nor a
            function, two outputs of one name.
    """
    argument = "linearize: outputs"
    if isinstance(outputs, str) or not isinstance(outputs, Sequence | Mapping):
        must = "be a sequence of names and functions, or a dict from names to these"
        raise invalid(argument, must, f"it was {outputs!r}")
    items = list(outputs.items() if isinstance(outputs, Mapping) else enumerate(outputs))
    known, found = _known(system, rows), []
    for key, wanted in items:
        name = _name_of(key, wanted, isinstance(outputs, Mapping))
        if callable(wanted):
            found.append(_function(f"{argument}[{key!r}]", name, wanted, state))
        elif not isinstance(wanted, str) or wanted not in known:
            must = f"hold functions and names among {[*known]}"
            raise invalid(argument, must, f"one was {wanted!r}")
        elif len(known[wanted]) > 1:
            kinds = " and ".join(KINDS[output.kind] for output in known[wanted])
            was = f"{wanted!r} was the name of {kinds}"
            fix = "Rename the constraint, or write a function of (t, q, v, params)."
            raise invalid(argument, "name one quantity each", was, fix)
        else:
            (output,) = known[wanted]
            labels = output.labels
            if name != wanted:
                labels = (name,) if len(labels) == 1 else tuple(name + _index(x) for x in labels)
            found.append(output._replace(name=name, labels=labels))
    result = Outputs(tuple(found))
    twice = [label for i, label in enumerate(result.labels) if label in result.labels[:i]]
    if twice:
        fix = "Leave one out, or give a dict from other names."
        raise invalid(argument, "have names of their own", f"two were {twice[0]!r}", fix)
    return result


def _index(label: str) -> str:
    """The index of an entry, `[0,1]`."""
    return label[label.find("[") : label.find("]") + 1]


KINDS = {
    "q": "a coordinate",
    "v": "a velocity",
    "u": "a quasi-velocity",
    "x": "a state of the system",
    "lam": "a multiplier",
}


def _name_of(key: Any, wanted: Any, named: bool) -> str:
    """The name of an output: its key in a dict, else its own."""
    if not named:
        own = wanted if isinstance(wanted, str) else getattr(wanted, "__name__", "<lambda>")
        return f"outputs[{key}]" if own == "<lambda>" else own
    if not isinstance(key, str) or not key:
        raise invalid("linearize: outputs", "have names as keys", f"one was {key!r}")
    return key


def _function(argument: str, name: str, wanted: Callable, state: tuple) -> Output:
    """An output by a function; checked by tracing it."""
    require_arity(argument, wanted, ("t", "q", "v", "params"))
    function = traced_function(wanted)
    shape = jax.eval_shape(lambda *state: real_array(argument, function(*state)), *state).shape
    labels = Coordinates({name: shape}, argument).labels
    return Output(name, "function", labels=labels, function=function)


def _known(system: System, rows: Sequence[str]) -> dict[str, list[Output]]:
    """The quantities of a name; labels of entries are names, too."""
    known: dict[str, list[Output]] = {}

    def enter(kind: str, labels: Sequence[str], names: Mapping[str, Sequence[int]]) -> None:
        every = dict(names) | {label: (i,) for i, label in enumerate(labels)}
        for name, places in every.items():
            entries = tuple(labels[i] for i in places)
            known.setdefault(name, []).append(Output(name, kind, (*places,), entries))

    labels, places = system.coordinates.labels, system.coordinates.places
    enter("q", labels, places)
    enter("v", [f"{x}'" for x in labels], {f"{name}'": i for name, i in places.items()})
    if system.quasi is not None:
        free = {name: i for i, name in enumerate(system.quasi.names) if i in system.quasi.free}
        for name, i in free.items():
            known.setdefault(name, []).append(Output(name, "u", (i,), (name,)))
    if system.states is not None:
        layout = system.states.layout
        enter("x", layout.labels, layout.places)
    by_name: dict[str, list[int]] = {}
    for i, label in enumerate(rows):
        by_name.setdefault(label.partition("[")[0], []).append(i)
    enter("lam", rows, by_name)
    return known
