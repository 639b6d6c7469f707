"""Fields of a stored run of a benchmark."""

from bench._harness import results

RUN_FIELDS = {"date", "commit", "machine", "versions", "native_loops", "quick"} | {
    "rows",
    "targets",
    "references",
}


def check_fields(run):
    assert set(run) == RUN_FIELDS
    assert set(run["machine"]) == {"cpu", "cores", "platform", "load"}
    assert set(run["versions"]) == {"python", *results.PACKAGES}
    for target in run["targets"]:
        assert set(target) == {"claim", "figure", "relation", "bound", "met"}
    for reference in run["references"]:
        assert set(reference) == {"figure", "what"}
    assert len({tuple(row) for row in run["rows"]}) == 1
