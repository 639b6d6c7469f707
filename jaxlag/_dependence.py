"""What the outputs of a traced program depend on."""

from typing import Any

from jax.extend.core import ClosedJaxpr, Jaxpr, Literal


def _inner(eqn: Any) -> Jaxpr | None:
    """The jaxpr of a call-like equation whose operands map one to one; else None."""
    if eqn.primitive.name not in _CALLS:
        return None
    for key in ("jaxpr", "call_jaxpr", "fun_jaxpr"):
        inner = eqn.params.get(key)
        jaxpr = inner.jaxpr if isinstance(inner, ClosedJaxpr) else inner
        sizes = (len(eqn.invars), len(eqn.outvars))
        if isinstance(jaxpr, Jaxpr) and (len(jaxpr.invars), len(jaxpr.outvars)) == sizes:
            return jaxpr
    return None


_CALLS = {"jit", "pjit", "closed_call", "core_call", "remat", "remat2", "checkpoint"} | {
    "custom_jvp_call",
    "custom_vjp_call",
}


def outputs_depend_on(jaxpr: Jaxpr, given: list[frozenset[str]]) -> list[frozenset[str]]:
    """Names that each output of a traced program depends on.

    A dependence that cancels only algebraically is still listed; one that is not listed is
    certainly absent.

    Args:
        jaxpr: the traced program.
        given: names that each of its inputs stands for; its constants stand for none.
    """
    nothing: frozenset[str] = frozenset()
    known: dict[Any, frozenset[str]] = dict(zip(jaxpr.invars, given, strict=True))

    def of(atom: Any) -> frozenset[str]:
        return nothing if isinstance(atom, Literal) else known.get(atom, nothing)

    for eqn in jaxpr.eqns:
        operands = [of(atom) for atom in eqn.invars]
        inner = _inner(eqn)
        if inner is not None:
            results = outputs_depend_on(inner, operands)
        elif eqn.primitive.name == "integer_pow" and eqn.params["y"] == 0:
            results = [nothing]  # x**0 is what differentiating x**1 leaves
        else:
            results = [nothing.union(*operands)] * len(eqn.outvars)
        known.update(zip(eqn.outvars, results, strict=True))
    return [of(atom) for atom in jaxpr.outvars]
