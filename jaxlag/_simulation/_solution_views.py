"""Views of a solution: as text, as a dict, as a dataset, as a figure."""

from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxlag._core._arrays import concrete
from jaxlag._core._errors import unsupported
from jaxlag._core._status import Status
from jaxlag._simulation._abstract_solution import AbstractSolution

LINES = 16
"""Largest number of motions of a batch in a figure."""

ELSEWHERE = {
    **dict.fromkeys(("ys", "y"), "motion.q and motion.v"),
    **dict.fromkeys(("qpos", "positions"), "motion.q"),
    **dict.fromkeys(("qvel", "velocities", "qdot", "qd"), "motion.v"),
    **dict.fromkeys(("qacc", "accelerations"), "motion.a"),
    **dict.fromkeys(("t", "time", "times"), "motion.ts"),
    **dict.fromkeys(("evaluate", "sol", "interpolation", "interp"), "motion.at(t)"),
    **dict.fromkeys(("result", "retcode"), "motion.status"),
    "derivative": "motion.at(t).v",
    "success": "motion.ok",
    "lagrange_multipliers": "motion.multipliers",
}
"""Attributes of solutions in other tools -> the same here."""


def described(motion: AbstractSolution) -> str:
    """A motion, or a batch of them, in one line."""
    system, (*batch, count) = motion.system, motion.ts.shape
    names = ", ".join(system.coordinates.names)
    times, many = f"{count} times", f"batch {tuple(batch)} of " if batch else ""
    if not concrete(motion.ts, motion.raw_status):
        return f"Solution({names}: {many}{times}, traced)"
    if not batch:
        times += f" from {float(motion.ts[0]):g} to {float(motion.ts[-1]):g} s"
    return f"Solution({names}: {many}{times}, {_counts(motion)})"


def _counts(motion: AbstractSolution) -> str:
    statuses = np.ravel(np.asarray(motion.status))
    found = Counter(Status(int(status)).name for status in statuses)
    if np.ndim(motion.status) == 0:
        return next(iter(found))
    return ", ".join(f"{count} {name}" for name, count in sorted(found.items(), key=_ok_first))


def _ok_first(item: tuple[str, int]) -> tuple[bool, int]:
    name, count = item
    return name != Status.ok.name, -count


def counted(motion: AbstractSolution) -> str:
    """How the motions of a batch ended: counts by status, and the first of each except "ok"."""
    status = np.asarray(motion.status)
    lines = [f"{status.size} motions: {_counts(motion)}"]
    for kind in sorted({int(x) for x in status.ravel()} - {int(Status.ok)}):
        index = tuple(int(i) for i in np.argwhere(status == kind)[0])
        lines.append(f"{list(index)}: {motion[index].message()}")
    return "\n".join(lines)


def columns(motion: AbstractSolution) -> dict[str, Any]:
    """Coordinates, their velocities, quasi-velocities and states by name, without the times."""
    system = motion.system
    found = {}
    for name in system.coordinates.names:
        found[name] = motion[name]
        found[f"{name}'"] = motion.rate(name)
    if system.quasi is not None:
        found |= {name: motion[name] for name in system.quasi.names}
    if system.states is not None:
        found |= {name: motion[name] for name in system.states.names}
    return found


def flat_quantities(saved: Mapping[str, Any]) -> dict[str, Any]:
    """Quantities by name; of a quantity that is a dict, by its name and the key."""
    return {
        f"{name} {key}".strip(): value
        for name, part in saved.items()
        for key, value in (part.items() if isinstance(part, dict) else [("", part)])
    }


def as_dict(motion: AbstractSolution) -> dict[str, np.ndarray]:
    """See `Solution.to_dict`."""
    found = {"t": motion.ts} | columns(motion) | flat_quantities(motion.saved)
    return {name: np.asarray(value) for name, value in found.items()}


def as_dataset(motion: AbstractSolution) -> Any:
    """See `Solution.to_xarray`."""
    found = columns(motion) | flat_quantities(motion.saved)
    values = {name: np.asarray(value) for name, value in found.items()}
    return dataset(np.asarray(motion.ts), values, {"status": np.asarray(motion.status)})


def dataset(
    ts: np.ndarray, values: Mapping[str, np.ndarray], facts: Mapping[str, np.ndarray]
) -> Any:
    """A dataset of one motion or a batch of them.

    Args:
        ts: (..., s), s.
        values: of each at these times, (..., s, ...), by name.
        facts: of each, (...), by name.

    Raises:
        ValueError: xarray is not installed; a coordinate is called "t", or as one of the facts.
    """
    try:
        import xarray
    except ImportError as error:
        raise unsupported(
            "`to_xarray`", "xarray is not installed", 'pip install "jaxlag[xarray]"'
        ) from error
    if "t" in values:
        why = "the coordinate 't' has the name of the times"
        raise unsupported("`to_xarray`", why, "Give it another name.")
    for name in facts:
        if name in values:
            why = f"{name!r} is a coordinate or a state, and how a motion ended"
            raise unsupported("`to_xarray`", why, "Give it another name.")
    batch = ts.ndim - 1
    axes = ("motion",) if batch == 1 else tuple(f"motion_{i}" for i in range(batch))
    first = ts[(0,) * batch]
    common = bool(np.all(ts == first))
    along = "t" if common else "save"
    variables = {}
    for name, value in values.items():
        more = [f"{name}_{i}" for i in range(value.ndim - batch - 1)]
        variables[name] = ((*axes, along, *more), value)
    variables |= {name: (axes, value) for name, value in facts.items()}
    time = ("t", first) if common else ((*axes, "save"), ts)
    return xarray.Dataset(variables, {"t": time})


def plotted(motion: AbstractSolution) -> Any:
    """See `Solution.plot`."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise unsupported(
            "`plot`", "matplotlib is not installed", 'pip install "jaxlag[plot]"'
        ) from error
    every = list(np.ndindex(motion.ts.shape[:-1]))
    count = len(every)
    indices = [every[i] for i in np.linspace(0, count - 1, min(count, LINES)).astype(int)]
    shapes = motion.system.coordinates.shapes
    paths = _paths(shapes)
    shapes = shapes | ({} if motion.system.states is None else motion.system.states.layout.shapes)
    panels = [*shapes, "energy"]
    width, count = 9.0 if paths else 6.0, len(panels)
    figure = Figure(figsize=(width, 0.6 + 1.8 * count), dpi=120, layout="constrained")
    grid = figure.add_gridspec(count, 2 if paths else 1)
    axes = [figure.add_subplot(grid[0, 0])]
    axes += [figure.add_subplot(grid[i, 0], sharex=axes[0]) for i in range(1, count)]
    plane = None
    if paths:
        plane = figure.add_subplot(grid[:, 1], aspect="equal", xlabel="x", ylabel="y")
    alone = len(indices) == 1
    ts, shown = np.asarray(motion.ts), {name: np.asarray(motion[name]) for name in shapes}
    shown["energy"] = np.asarray(motion.energy)
    for k, index in enumerate(indices):
        for ax, name in zip(axes, panels, strict=True):
            lines = shown[name][index].reshape(ts.shape[-1], -1)
            for j, line in enumerate(lines.T):
                label = _label(name, shapes.get(name, ()), j)
                ax.plot(ts[index], line, color=f"C{j if alone else k}", lw=1, label=label)
        for j, path in enumerate(paths):
            x, y = path({name: value[index] for name, value in shown.items()})
            assert plane is not None
            plane.plot(x, y, color=f"C{j if alone else k}", lw=1)
            plane.plot(x[:1], y[:1], ".", color=f"C{j if alone else k}")
    for ax, name in zip(axes, panels, strict=True):
        ax.set_ylabel(f"{name} [J]" if name == "energy" else name)
        ax.grid(alpha=0.3)
        ax.margins(x=0)
        if alone and 1 < int(np.prod(shapes.get(name, ()), dtype=int)) <= 6:
            ax.legend(fontsize=7)
    axes[-1].set_xlabel("t [s]")
    if plane is not None:
        plane.grid(alpha=0.3)
    if len(indices) < count:
        figure.suptitle(f"{len(indices)} of {count} motions", fontsize=10)
    return figure


def _label(name: str, shape: tuple[int, ...], j: int) -> str:
    index = np.unravel_index(j, shape) if shape else ()
    return f"{name}[{','.join(str(int(i)) for i in index)}]" if shape else name


def _paths(shapes: dict[str, tuple[int, ...]]) -> list[Any]:
    """Functions of the coordinates by name that return (x, y) of points in the plane.

    For x and y, x1 and y1, and so on, and for points of two components.
    """
    found: list[Any] = []
    scalars = {name for name, shape in shapes.items() if shape == ()}
    for x in (name for name in shapes if name.startswith("x")):
        y, z = f"y{x[1:]}", f"z{x[1:]}"
        if {x, y} <= scalars and z not in shapes:
            found.append(lambda q, x=x, y=y: (q[x], q[y]))
    for name, shape in shapes.items():
        if len(shape) in (1, 2) and shape[-1] == 2:
            for j in range(shape[0] if len(shape) == 2 else 1):

                def of(q: dict[str, np.ndarray], name: str = name, j: int = j) -> Any:
                    points = q[name].reshape(len(q[name]), -1, 2)
                    return points[:, j, 0], points[:, j, 1]

                found.append(of)
    return found
