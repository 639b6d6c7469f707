"""One solve of a double pendulum, with XLA's setting and without it, compared with diffrax.

All cases use Dormand and Prince's method of order 8. jaxlag has its own `Dopri8` and its scalar
program. diffrax has its `Dopri8` and PID control, on equations written by hand and on naive
autodiff (`jax.hessian`, `jnp.linalg.solve`). "setting" is the setting that importing jaxlag makes:
XLA's bound on the loops that it compiles to one native function (needed before jax 0.12). "native"
is whether XLA does so. Errors are the largest over all saved states, against the hand-written
equations at tolerance 1e-13 with a step ending on every save time.
"""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp

from bench._harness.timing import Call, Reference, Report, Target, build, spread
from bench._harness.workers import under_both_settings
from bench._problems import double_pendulum as pendulum
from jaxlag._core import _xla

SAVES = 501


def prepare(quick: bool) -> tuple[dict[str, Call], dict[str, Any]]:
    """Compile every case in this process: the calls to time, and the columns known before."""
    args = (pendulum.start(), pendulum.params(), jnp.asarray(pendulum.TOLERANCE))
    reference = pendulum.reference(pendulum.times(SAVES))
    calls: dict[str, Call] = {}
    facts: dict[str, Any] = {}
    for equations, saves, function in _cases(quick):
        program = build(function, *args)
        ended = program.call(*args)
        expected = reference if saves == SAVES else reference[-1:]
        name = f"{equations} {saves}"
        calls[name] = lambda call=program.call: call(*args)
        facts[name] = {
            "equations": equations,
            "saves": saves,
            "native": _xla.in_force(),
            "accepted": int(ended.accepted),
            "rejected": int(ended.rejected),
            "error": float(jnp.max(jnp.abs(ended.states - expected))),
            **program.cost(),
        }
    return calls, facts


def _cases(quick: bool) -> list[tuple[str, int, Callable]]:
    few, many = pendulum.times(2), pendulum.times(SAVES)
    cases = [
        ("jaxlag", 2, pendulum.with_jaxlag(few)),
        ("jaxlag", SAVES, pendulum.with_jaxlag(many)),
        ("by hand", 2, pendulum.with_diffrax(pendulum.by_hand, few)),
        ("naive", 2, pendulum.with_diffrax(pendulum.naive, few)),
    ]
    if not quick:
        cases.append(("by hand", SAVES, pendulum.with_diffrax(pendulum.by_hand, many)))
        cases.append(("naive", SAVES, pendulum.with_diffrax(pendulum.naive, many)))
    return cases


def run(quick: bool) -> Report:
    """Both settings in turn."""
    known, samples = under_both_settings("solve", quick)
    rows = {
        (setting, case): {"setting": setting, **facts, **spread(samples[setting, case], "ms")}
        for setting, cases in known.items()
        for case, facts in cases.items()
    }
    return Report(list(rows.values()), *_judged(rows))


def _judged(rows: dict[tuple[str, str], Any]) -> tuple[list[Target], list[Reference]]:
    def ms(setting: str, case: str) -> float:
        return rows[setting, case]["min_ms"]

    few, many = (rows["on", f"jaxlag {saves}"]["accepted"] for saves in (2, SAVES))
    setting_gain = ms("off", "jaxlag 2") / ms("on", "jaxlag 2")
    targets = [
        Target(
            "times faster: jaxlag with the setting than naive autodiff without, 2 save times",
            ms("off", "naive 2") / ms("on", "jaxlag 2"),
            ">=",
            10.0,
        ),
        Target(
            f"% more accepted steps for {SAVES} save times than for 2",
            100.0 * (many - few) / few,
            "<=",
            5.0,
        ),
    ]
    references = [
        Reference(
            f"{ms('on', 'jaxlag 2') / ms('on', 'by hand 2'):.3g}",
            "times as long: jaxlag as the hand-written equations, both with the setting",
        ),
        Reference(
            f"{ms('on', f'jaxlag {SAVES}') / ms('on', 'jaxlag 2'):.3g}",
            f"times as long: {SAVES} save times as 2, jaxlag with the setting",
        ),
        Reference("0.105 ms", "stages unrolled on scalar state, where jaxlag is to get"),
        Reference("0.123 ms", "heyoka (C++, Taylor series) at the same tolerance"),
    ]
    what = "times faster: jaxlag with the setting than without, 2 save times"
    if _xla.needed():
        targets.insert(1, Target(what, setting_gain, ">=", 2.0))
    else:
        references.insert(0, Reference(f"{setting_gain:.3g}", what + " (this jax needs none)"))
    return targets, references
