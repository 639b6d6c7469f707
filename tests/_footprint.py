"""Memory maps and memory of each test process: peaks are reported and bounded.

Every compiled program holds memory maps. Linux allows a process some 65,000 of them; beyond, the
process dies in the next test. Each process therefore counts its maps after every test. The summary
names the peaks, and a run beyond the bounds fails.
"""

import resource
import sys
from pathlib import Path

import pytest

MAPS = 20_000  # a third of the limit of Linux
BYTES = 4e9
UNIT = 1 if sys.platform == "darwin" else 1024  # of ru_maxrss, bytes


def maps():
    """Number of memory maps of this process; 0 if the system does not report it."""
    try:
        return Path("/proc/self/maps").read_bytes().count(b"\n")
    except OSError:
        return 0


def resident_bytes():
    """Current memory of this process, bytes; 0 if the system does not report it."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()
    except OSError:
        return 0


class Footprint:
    """Counts in every process of a run; the main process collects the counts of the workers."""

    def __init__(self, most_maps=MAPS, most_bytes=BYTES):
        self.bounds = most_maps, most_bytes
        self.most, self.after = 0, "no test"
        self.reports = {}

    def pytest_runtest_logreport(self, report):
        """Count before teardown: after the last test of a module its programs are dropped.

        The main process of several workers receives their reports, too: its own count is low.
        """
        if report.when == "call" and (count := maps()) > self.most:
            self.most, self.after = count, report.nodeid

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node):
        """A crashed worker has no report; the run has failed then."""
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
