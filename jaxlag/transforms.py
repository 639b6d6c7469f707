"""Transforms: maps from all real numbers onto the values that a parameter of `fit` may take.

`fit(..., transforms={"m": jl.transforms.Positive()})`: an optimizer moves freely in unconstrained
numbers, and the parameter is valid whatever they are.
"""

from jaxlag._fit._transforms import SPD as SPD
from jaxlag._fit._transforms import AbstractTransform as AbstractTransform
from jaxlag._fit._transforms import Bounded as Bounded
from jaxlag._fit._transforms import Inertia as Inertia
from jaxlag._fit._transforms import Positive as Positive
from jaxlag._fit._transforms import PseudoInertia as PseudoInertia
