"""Progress of sweeps, on a terminal and in the log; Ctrl-C."""

import os
import signal
import sys
import threading

import numpy as np
import pytest

import jaxlag as jl
from jaxlag import Status
from jaxlag._sweep._progress import Progress

TS = np.linspace(0.0, 1.0, 3)
N = 2500
SPRING = jl.System(lambda t, q, v, p: 0.5 * v[0] ** 2 - 0.5 * p["k"] * q[0] ** 2, ("x",))


def draw(key, index):
    return jl.Case([1.0], [0.0], {"k": 1.0 + index.astype(float)})


def swept(**options):
    return jl.sweep(SPRING, draw, N, TS, **options)


def test_a_line_of_the_log_every_30_seconds(caplog):
    now = iter([0.0, 10.0, 31.0, 31.0, 50.0])
    ok, failed = int(Status.ok), int(Status.max_steps)
    with caplog.at_level("INFO", "jaxlag"):
        progress = Progress(400, 100, lambda: next(now))
        for k in range(3):
            progress.advance(np.array([ok] * 30 + [failed] * k))
        progress.close()
    assert caplog.messages == ["Sweep: 161 of 400 trajectories, 1.97/s, 1 failed, 121 s left"]


def test_a_bar_on_a_terminal(capsys, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    run = swept(simulate_options={"max_steps": 20})
    failed = N - run.report.statuses["ok"]
    shown = capsys.readouterr().err
    assert failed > 100
    assert "sweep: 100%" in shown
    assert "2.50k/2.50k" in shown
    assert f"failed={failed}" in shown


def test_nothing_is_shown_elsewhere(capsys):
    swept()
    captured = capsys.readouterr()
    assert (captured.out, captured.err) == ("", "")


def interrupting(at, times=1):
    """A reduction that is interrupted while it sees a block."""

    def add(value, rows):
        if rows["index"][0] == at:
            for _ in range(times):
                os.kill(os.getpid(), signal.SIGINT)
        return value + len(rows["index"])

    return jl.Reduction(int, add, int.__add__)


@pytest.mark.parametrize("times", [1, 2])
def test_an_interrupted_sweep_keeps_its_blocks(tmp_path, times):
    path, handler = tmp_path / "runs.zarr", signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt, match="the same call goes on" if times == 1 else "^$"):
        swept(store=path, reduce=interrupting(1024, times))
    assert signal.getsignal(signal.SIGINT) is handler
    assert (jl.open_sweep(path).status >= 0).sum() == 2048
    run = swept(store=path, reduce=interrupting(-1))
    assert run.report.computed == N - 2048
    assert run.reduced == N


def test_a_sweep_in_a_thread_leaves_signals_alone():
    runs = []
    thread = threading.Thread(target=lambda: runs.append(swept()))
    thread.start()
    thread.join()
    assert runs[0].ok.all()
