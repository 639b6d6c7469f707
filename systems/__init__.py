"""Systems of Pila, "Introduction to Lagrangian Dynamics", declared for jaxlag, and a few beyond.

Read `catalogue/chapter3/simple_pendulum.py` first. Every system has a module like it, with its
sketch, its energies and its forces as in the book:

    from systems import simple_pendulum

    simple_pendulum.system  # the declaration
    simple_pendulum.entry.example  # parameters and a start

`python -m systems` lists the systems, runs their examples and checks reference files against them.
"""

from types import ModuleType

from systems import catalogue


def __getattr__(name: str) -> ModuleType:
    """The module of a system."""
    try:
        return catalogue.module(name)
    except KeyError:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}") from None
