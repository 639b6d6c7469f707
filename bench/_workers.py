"""Child processes that time the same cases under different settings, taking turns.

A setting that XLA reads once per process needs a process of its own. Each worker compiles its
cases once, alone on the machine; then the workers are asked for a round of timings in turn.
"""

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

import jax

from bench._harness import interleaved

ROOT = Path(__file__).parent.parent


class Worker:
    """A process that has compiled the cases of a benchmark under `settings`.

    It starts without XLA_FLAGS: those of this process hold what importing jaxlag here has put in.

    Attributes:
        facts: what the benchmark's `prepare` knows of its cases before they are timed.
    """

    def __init__(self, benchmark: str, quick: bool, settings: Mapping[str, str]) -> None:
        environment = {key: value for key, value in os.environ.items() if key != "XLA_FLAGS"}
        self._process = subprocess.Popen(
            [sys.executable, "-m", "bench._workers", benchmark, *(["--quick"] if quick else [])],
            env={**environment, **settings},
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.facts: dict[str, Any] = self._answer()

    def seconds(self) -> dict[str, list[float]]:
        """Seconds of every run in one turn of every case."""
        assert self._process.stdin is not None
        print("turn", file=self._process.stdin, flush=True)
        return self._answer()

    def __enter__(self) -> "Worker":
        return self

    def __exit__(self, *_: object) -> None:
        self._process.communicate()  # its input ends, and so does it

    def _answer(self) -> Any:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise RuntimeError(f"a worker ended early with status {self._process.wait()}")
        return json.loads(line)


def serve(benchmark: str, quick: bool) -> None:
    """The other end: facts first, then the timings of one turn for every line read."""
    calls, facts = import_module(f"bench.{benchmark}").prepare(quick)
    print(json.dumps(facts), flush=True)
    for _ in sys.stdin:
        print(json.dumps(interleaved(calls, rounds=1)), flush=True)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    serve(sys.argv[1], "--quick" in sys.argv)
