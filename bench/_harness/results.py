"""Result files, and their text for the terminal."""

import json
import os
import platform
import re
import subprocess
from collections.abc import Mapping
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from bench._harness.timing import Report
from jaxlag._core import _xla

FOLDER = Path(__file__).parents[1] / "results"
PACKAGES = ("jax", "jaxlib", "diffrax", "equinox", "numpy", "jaxlag")


def circumstances() -> dict[str, Any]:
    """Date, commit, machine and versions; call this before the measurement."""
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "commit": _commit(),
        "machine": {
            "cpu": _cpu(),
            "cores": len(os.sched_getaffinity(0))
            if hasattr(os, "sched_getaffinity")
            else os.cpu_count(),
            "platform": platform.platform(),
            "load": round(os.getloadavg()[0], 2),  # of other processes, before the start
        },
        "versions": {"python": platform.python_version()}
        | {package: version(package) for package in PACKAGES},
        "native_loops": _xla.in_force(),
    }


def save(
    name: str,
    headline: str,
    report: Report,
    circumstances: Mapping[str, Any],
    quick: bool,
    folder: Path,
) -> Path:
    """Store a run, replacing the one with the same version of jax; return the path of the file."""
    run = {
        **circumstances,
        "quick": quick,
        "rows": [{key: _short(value) for key, value in row.items()} for row in report.rows],
        "targets": [
            {**vars(target), "figure": _short(target.figure), "met": target.met}
            for target in report.targets
        ],
        "references": [reference._asdict() for reference in report.references],
    }
    path = (folder / "quick" if quick else folder) / f"{name}.json"
    runs = json.loads(path.read_text())["runs"] if path.exists() else []
    runs = [old for old in runs if old["versions"]["jax"] != run["versions"]["jax"]] + [run]
    runs.sort(key=lambda run: [int(x) for x in run["versions"]["jax"].split(".") if x.isdigit()])
    content = {"benchmark": name, "measures": headline, "runs": runs}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(_compact(content) + "\n")
    return path


def _compact(content: Mapping[str, Any]) -> str:
    """JSON with one line for each table row."""
    rows = [row for run in content["runs"] for row in run["rows"]]
    marks = iter(range(len(rows)))
    runs = [{**run, "rows": [f"row {next(marks)}" for _ in run["rows"]]} for run in content["runs"]]
    lines = json.dumps({**content, "runs": runs}, indent=1)
    return re.sub('"row ([0-9]+)"', lambda found: json.dumps(rows[int(found[1])]), lines)


def text(report: Report) -> str:
    """Table, targets and references for the terminal."""
    rows = report.shown or report.rows
    heads = list(rows[0])
    cells = [heads] + [[_cell(row[head]) for head in heads] for row in rows]
    widths = [max(len(line[i]) for line in cells) for i in range(len(heads))]
    lines = [
        "  ".join(
            c.ljust(w) if i == 0 else c.rjust(w)
            for i, (c, w) in enumerate(zip(line, widths, strict=True))
        )
        for line in cells
    ]
    lines.append("")
    for target in report.targets:
        verdict = "met" if target.met else "MISSED"
        figure = f"{target.figure:.3g} {target.relation} {target.bound:g}"
        lines.append(f"target {verdict:<6}  {figure:<20}  {target.claim}")
    lines += [f"reference      {figure:<20}  {what}" for figure, what in report.references]
    return "\n".join(lines)


def _cell(value: Any) -> str:
    if value is None:
        return ""
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _short(value: Any) -> Any:
    return float(f"{value:.5g}") if isinstance(value, float) else value


def _commit() -> str:
    command = ["git", "describe", "--always", "--dirty", "--abbrev=12"]
    try:
        done = subprocess.run(
            command, cwd=FOLDER.parent, capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return done.stdout.strip()


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()
