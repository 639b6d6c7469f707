"""From a declared system to the terms of its equations of motion."""

from jaxlag._lowering._array import ArrayTerms as ArrayTerms
from jaxlag._lowering._structure import Structure as Structure
from jaxlag._lowering._structure import find_structure as find_structure
