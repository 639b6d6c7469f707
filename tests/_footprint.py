"""What a test process holds: memory maps and memory, their peaks reported and bounded.

Every compiled program keeps memory maps. Linux gives a process some 65,000 of them, and one that
runs out dies in whatever test comes next. So each process counts its own after every test, the
summary names the peaks, and a run beyond the bounds fails.
"""

import resource
import sys
from pathlib import Path

import pytest

MAPS = 20_000  # a third of what Linux gives
BYTES = 4e9
UNIT = 1 if sys.platform == "darwin" else 1024  # of ru_maxrss, bytes


def maps():
    """Number of memory maps of this process; 0 where the system does not tell."""
    try:
        return Path("/proc/self/maps").read_bytes().count(b"\n")
    except OSError:
        return 0


def held():
    """Memory of this process now, bytes; 0 where the system does not tell."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()
    except OSError:
        return 0


class Footprint:
    """Counts in every process of a run; the one that the workers report to sums up."""

    def __init__(self, most_maps=MAPS, most_bytes=BYTES):
        self.bounds = most_maps, most_bytes
        self.most, self.after = 0, "no test"
        self.reports = {}

    def pytest_runtest_logreport(self, report):
        """Before teardown, since after the last test of a module its programs are gone.

        A process that hands its tests to workers hears of theirs, too: its own count is low.
        """
        if report.when == "call" and (count := maps()) > self.most:
            self.most, self.after = count, report.nodeid

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node):
        """Of a worker that crashed nothing is known; the run has failed then."""
        if footprint := getattr(node, "workeroutput", {}).get("footprint"):
            self.reports[node.gateway.id] = footprint

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionfinish(self, session):
        own = self.most, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * UNIT, self.after
        if hasattr(session.config, "workeroutput"):
            session.config.workeroutput["footprint"] = own
            return
        self.reports = self.reports or {"this process": own}
        if any(self.excess(report) for report in self.reports.values()):
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def excess(self, report):
        return any(found > bound for found, bound in zip(report, self.bounds, strict=False))

    def pytest_terminal_summary(self, terminalreporter):
        most_maps, most_bytes = self.bounds
        terminalreporter.section("peaks of the test processes")
        for name, report in sorted(self.reports.items()):
            count, size, after = report
            terminalreporter.line(
                f"{name}: {count} memory maps (bound {most_maps}, most after {after}), "
                f"{size / 1e9:.1f} GB (bound {most_bytes / 1e9:.1f})"
                + ("  TOO MUCH: the run fails" if self.excess(report) else "")
            )
