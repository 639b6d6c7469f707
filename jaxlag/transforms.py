"""Transforms: maps from all real numbers onto the allowed values of a parameter of `fit`.

`fit(..., transforms={"m": jl.transforms.Positive()})`: the optimizer works on unconstrained
numbers, and the parameter is always valid.
"""

from jaxlag._fit._transforms import SPD as SPD
from jaxlag._fit._transforms import AbstractTransform as AbstractTransform
from jaxlag._fit._transforms import Bounded as Bounded
from jaxlag._fit._transforms import Inertia as Inertia
from jaxlag._fit._transforms import Positive as Positive
from jaxlag._fit._transforms import PseudoInertia as PseudoInertia
