"""From a declared system to the terms of its equations of motion."""

from jaxlag._lowering._array import ArrayTerms as ArrayTerms
from jaxlag._lowering._derive import Equations as Equations
from jaxlag._lowering._findings import Findings as Findings
from jaxlag._lowering._findings import find as find
from jaxlag._lowering._lower import OPERATIONS as OPERATIONS
from jaxlag._lowering._lower import Lowered as Lowered
from jaxlag._lowering._scalar import ScalarTerms as ScalarTerms
from jaxlag._lowering._structure import Structure as Structure
from jaxlag._lowering._structure import find_structure as find_structure
