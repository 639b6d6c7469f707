"""The terms of the equations of motion, derived from a declared system."""

from jaxlag._lowering._acceleration_program import AccelerationProgram as AccelerationProgram
from jaxlag._lowering._acceleration_program import ArrayProgram as ArrayProgram
from jaxlag._lowering._acceleration_program import Choices as Choices
from jaxlag._lowering._acceleration_program import State as State
from jaxlag._lowering._array_terms import ArrayTerms as ArrayTerms
from jaxlag._lowering._array_terms import SolveConstants as SolveConstants
from jaxlag._lowering._graph._straight_line import Program as Program
from jaxlag._lowering._lower import OPERATIONS as OPERATIONS
from jaxlag._lowering._lower import Lowered as Lowered
from jaxlag._lowering._quasi_equations import QuasiState as QuasiState
from jaxlag._lowering._row_layout import check_kinematics as check_kinematics
from jaxlag._lowering._row_layout import layout as layout
from jaxlag._lowering._scalar_program import ScalarProgram as ScalarProgram
from jaxlag._lowering._sparse_program import find_sparsity as find_sparsity
from jaxlag._lowering._sparse_program import sparse_kkt as sparse_kkt
from jaxlag._lowering._sparsity import Compressed as Compressed
from jaxlag._lowering._sparsity import Sparsity as Sparsity
from jaxlag._lowering._sparsity import SparsityFound as SparsityFound
from jaxlag._lowering._structure import Structure as Structure
from jaxlag._lowering._structure import find_structure as find_structure
from jaxlag._lowering._symbolic._symbolic_system import Equations as Equations
from jaxlag._lowering._symbolic._system_properties import find as find
from jaxlag._lowering._terms import AbstractTerms as AbstractTerms
