"""Child processes that time the same cases under different settings, in turn.

A setting that XLA reads once per process needs its own process. Each worker compiles its cases
once, while the others wait. Then the workers run one round of timings each, in turn.
"""

import json
import os
import subprocess
import sys
from collections import defaultdict
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from importlib import import_module
from pathlib import Path
from typing import Any

import jax

from bench._harness.timing import interleaved
from jaxlag._core import _xla

ROOT = Path(__file__).parents[2]


def fresh_process(
    script: str | Path, *arguments: str, limit_s: float | None = None, **settings: str
) -> subprocess.CompletedProcess[str]:
    """A script that has run in its own process, without the settings of XLA and JAX of this one.

    Args:
        script: its path. As a module of a package it would import jax before timing starts.
        *arguments: of its command line.
        limit_s: bound on its time.
        **settings: variables of its environment.

    Raises:
        TimeoutExpired: it took longer.
    """
    kept = {k: x for k, x in os.environ.items() if k != "XLA_FLAGS" and not k.startswith("JAX_")}
    return subprocess.run(
        [sys.executable, str(script), *arguments],
        env={**kept, "PYTHONPATH": str(ROOT), **settings},
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=limit_s,
    )


class Worker:
    """A process that has compiled the cases of a benchmark under `settings`.

    It starts without XLA_FLAGS, because importing jaxlag has changed them in this process.
    `interpreter` is its Python interpreter, `core` the only CPU core that it uses.

    Attributes:
        facts: properties of the cases before timing, from the benchmark's `prepare`.
    """

    def __init__(
        self,
        benchmark: str,
        quick: bool,
        settings: Mapping[str, str],
        interpreter: str = sys.executable,
        core: int | None = None,
    ) -> None:
        environment = {key: value for key, value in os.environ.items() if key != "XLA_FLAGS"}
        options = ["--quick"] if quick else []
        options += [] if core is None else [f"--core={core}"]
        self._process = subprocess.Popen(
            [interpreter, "-m", "bench._harness.workers", benchmark, *options],
            env={**environment, **settings},
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.facts: dict[str, Any] = self._answer()

    def seconds(self, cases: Sequence[str] | None = None) -> dict[str, list[float]]:
        """Seconds of every run in one round of all cases, or of the named ones."""
        assert self._process.stdin is not None
        print(json.dumps(cases), file=self._process.stdin, flush=True)
        return self._answer()

    def __enter__(self) -> "Worker":
        return self

    def __exit__(self, *_: object) -> None:
        self._process.communicate()  # it exits when its input ends

    def _answer(self) -> Any:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError(f"a worker ended early with status {self._process.wait()}")
        return json.loads(line)


def under_both_settings(
    benchmark: str, quick: bool
) -> tuple[dict[str, dict[str, Any]], dict[tuple[str, str], list[float]]]:
    """(facts by setting, seconds by setting and case), with XLA's setting on and off in turn."""
    samples: dict[tuple[str, str], list[float]] = defaultdict(list)
    with ExitStack() as stack:
        workers = {
            setting: stack.enter_context(Worker(benchmark, quick, {_xla.SWITCH: switch}))
            for setting, switch in (("on", "1"), ("off", "0"))
        }
        for _ in range(5 if quick else 20):
            for setting, worker in workers.items():
                for case, seconds in worker.seconds().items():
                    samples[setting, case] += seconds
    return {setting: worker.facts for setting, worker in workers.items()}, samples


def serve(benchmark: str, quick: bool) -> None:
    """Run as a worker: print the facts, then the timings of one round for every line read."""
    # Output of libraries must not mix with the answers.
    with os.fdopen(os.dup(sys.stdout.fileno()), "w") as answers:
        os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
        calls, facts = import_module(f"bench.{benchmark}").prepare(quick)
        print(json.dumps(facts), file=answers, flush=True)
        for line in sys.stdin:
            names = json.loads(line)
            chosen = calls if names is None else {name: calls[name] for name in names}
            print(json.dumps(interleaved(chosen, rounds=1)), file=answers, flush=True)


def main(options: Sequence[str]) -> None:
    """A worker's command line: the benchmark, --quick, --core=NUMBER."""
    for option in options[1:]:
        if option.startswith("--core="):  # before XLA counts the cores it may use
            os.sched_setaffinity(0, {int(option.removeprefix("--core="))})
    jax.config.update("jax_enable_x64", True)
    serve(options[0], "--quick" in options)


if __name__ == "__main__":
    main(sys.argv[1:])
