"""From a declared system to the terms of its equations of motion."""

from jaxlag._lowering._array import ArrayTerms as ArrayTerms
from jaxlag._lowering._array import Prepared as Prepared
from jaxlag._lowering._findings import find as find
from jaxlag._lowering._lower import OPERATIONS as OPERATIONS
from jaxlag._lowering._lower import Lowered as Lowered
from jaxlag._lowering._program import Program as Program
from jaxlag._lowering._rates import Moving as Moving
from jaxlag._lowering._rows import check_kinematics as check_kinematics
from jaxlag._lowering._rows import layout as layout
from jaxlag._lowering._scalar import ScalarPrepared as ScalarPrepared
from jaxlag._lowering._scalar import ScalarTerms as ScalarTerms
from jaxlag._lowering._scene import Equations as Equations
from jaxlag._lowering._structure import Structure as Structure
from jaxlag._lowering._structure import find_structure as find_structure
