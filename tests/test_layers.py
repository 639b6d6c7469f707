"""Which package may import which, by the syntax tree: includes late imports and those for types.

The order is model -> lowering -> system -> integration -> gradient -> simulation -> fit, sweep.
"""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import jaxlag

ROOT = Path(jaxlag.__file__).parent
REPO = Path(__file__).parents[1]
FILES = sorted(ROOT.rglob("*.py"))
MOST = 20
"""Largest number of source files in a folder."""
FOLDERS = sorted(
    {path.parent for top in ("jaxlag", "bench", "systems") for path in (REPO / top).rglob("*.py")}
    - {REPO / "systems" / "catalogue" / "chapter3"}  # 35 independent systems
)

_BASE = ("_core", "_linalg", "_tracing", "_model")
_TO_SYSTEM = (*_BASE, "_lowering", "solvers", "_system")
ALLOWED = {
    "_core": (),
    "_linalg": ("_core",),
    "_tracing": ("_core",),
    "solvers": ("_core",),
    "math": ("_core", "_tracing"),
    "rotation": ("_core",),
    "_model": _BASE,
    "energy": ("_core", "_tracing", "_model", "math", "rotation"),
    "_lowering": _BASE,
    "_system": _TO_SYSTEM,
    "_statics": _TO_SYSTEM,
    "testing": _TO_SYSTEM,
    "_integration": _TO_SYSTEM,
    "_gradient": ("_core", "_integration"),
    "_simulation": (*_TO_SYSTEM, "_statics", "_integration", "_gradient"),
    "_analysis": (*_TO_SYSTEM, "_statics", "_simulation"),
    "_fit": ("_core", "_tracing", "_model", "_system", "_simulation"),
    "_sweep": ("_core", "_tracing", "_model", "_system", "_simulation"),
    "transforms": ("_fit",),
}
WITHIN_LOWERING = {
    "_graph": (),
    "_jaxpr": ("_graph",),
    "_emit": ("_graph", "_jaxpr"),
    "_symbolic": ("_graph", "_jaxpr", "_array_terms", "_row_layout"),
    "_verification": ("_graph", "_symbolic", "_array_terms", "_row_layout"),
    "_structure": (),
    "_terms": (),
    "_row_layout": ("_graph", "_jaxpr"),
    "_array_terms": ("_structure", "_terms", "_row_layout"),
    "_sparsity": ("_jaxpr",),
    "_sparse_program": ("_sparsity", "_array_terms", "_row_layout"),
    "_quasi_equations": ("_structure", "_row_layout", "_array_terms"),
    "_acceleration_program": ("_terms", "_array_terms", "_quasi_equations", "_sparse_program"),
    "_term_codes": ("_graph",),
    "_lower": ("_graph", "_jaxpr", "_symbolic", "_verification", "_term_codes"),
    "_interpreted_terms": ("_emit", "_symbolic", "_terms", "_array_terms", "_term_codes", "_lower"),
}


def name(path: Path) -> str:
    """The module name in imports."""
    parts = ("jaxlag", *path.relative_to(ROOT).with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {name(path): path for path in FILES}


def imported(path: Path) -> list[tuple[int, str]]:
    """(line, module) of every import of this package."""
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "jaxlag":
            for alias in node.names:
                module = f"{node.module}.{alias.name}"
                found.append((node.lineno, module if module in MODULES else str(node.module)))
        elif isinstance(node, ast.Import):
            names = (alias.name for alias in node.names)
            found += [(node.lineno, x) for x in names if x.split(".")[0] == "jaxlag"]
    return found


def test_every_package_has_allowed_imports():
    assert {module.split(".")[1] for module in MODULES if "." in module} == set(ALLOWED)


@pytest.mark.parametrize("module", sorted(MODULES.keys() - {"jaxlag"}))
def test_modules_import_only_lower_packages(module):
    package, *inner = module.split(".")[1:]
    for line, other in imported(MODULES[module]):
        at = f"{MODULES[module]}:{line} imports {other}"
        assert other != "jaxlag", f"{at}, which is for users"
        target, *part = other.split(".")[1:]
        assert target == package or target in ALLOWED[package], at
        if target == package == "_lowering" and inner and inner[0] in WITHIN_LOWERING:
            assert part, at
            assert part[0] == inner[0] or part[0] in WITHIN_LOWERING[inner[0]], at


def test_imports_have_no_cycle():
    """A facade imports its modules; they do not import it."""
    needs = {module: {other for _, other in imported(path)} for module, path in MODULES.items()}
    assert len(list(TopologicalSorter(needs).static_order())) == len(MODULES)


@pytest.mark.parametrize("folder", FOLDERS, ids=str)
def test_folders_have_few_source_files(folder):
    files = [path for path in folder.glob("*.py") if path.name != "__init__.py"]
    assert len(files) <= MOST
