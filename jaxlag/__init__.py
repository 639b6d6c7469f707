"""Differentiable dynamics from a Lagrangian, in JAX."""

from importlib.metadata import version as _version

from jaxlag._core import _old_layout, _xla

_xla.configure()
_old_layout.install()

from jaxlag import energy as energy  # noqa: E402
from jaxlag import math as math  # noqa: E402
from jaxlag import rotation as rotation  # noqa: E402
from jaxlag import solvers as solvers  # noqa: E402
from jaxlag import testing as testing  # noqa: E402
from jaxlag._core._errors import AssemblyError as AssemblyError  # noqa: E402
from jaxlag._core._errors import EquilibriumError as EquilibriumError  # noqa: E402
from jaxlag._core._errors import SimulationError as SimulationError  # noqa: E402
from jaxlag._core._status import Status as Status  # noqa: E402
from jaxlag._fit._compare import Candidate as Candidate  # noqa: E402
from jaxlag._fit._compare import Comparison as Comparison  # noqa: E402
from jaxlag._fit._compare import compare as compare  # noqa: E402
from jaxlag._fit._descent import Descent as Descent  # noqa: E402
from jaxlag._fit._experiment import Experiment as Experiment  # noqa: E402
from jaxlag._fit._fit import fit as fit  # noqa: E402
from jaxlag._fit._fit_result import FitResult as FitResult  # noqa: E402
from jaxlag._fit._free_parameters import Prior as Prior  # noqa: E402
from jaxlag._fit._predict import Prediction as Prediction  # noqa: E402
from jaxlag._fit._predict import predict as predict  # noqa: E402
from jaxlag._fit._transforms import SPD as SPD  # noqa: E402
from jaxlag._fit._transforms import Bounded as Bounded  # noqa: E402
from jaxlag._fit._transforms import Inertia as Inertia  # noqa: E402
from jaxlag._fit._transforms import Positive as Positive  # noqa: E402
from jaxlag._fit._transforms import PseudoInertia as PseudoInertia  # noqa: E402
from jaxlag._gradient._modes import GradientMode as GradientMode  # noqa: E402
from jaxlag._lowering._terms import Terms as Terms  # noqa: E402
from jaxlag._model._constraints import Baumgarte as Baumgarte  # noqa: E402
from jaxlag._model._constraints import Holonomic as Holonomic  # noqa: E402
from jaxlag._model._constraints import Pfaffian as Pfaffian  # noqa: E402
from jaxlag._model._forces import Couple as Couple  # noqa: E402
from jaxlag._model._forces import GeneralizedForce as GeneralizedForce  # noqa: E402
from jaxlag._model._forces import PointForce as PointForce  # noqa: E402
from jaxlag._model._forces import Rayleigh as Rayleigh  # noqa: E402
from jaxlag._model._input_signals import Feedback as Feedback  # noqa: E402
from jaxlag._model._input_signals import Function as Function  # noqa: E402
from jaxlag._model._input_signals import Linear as Linear  # noqa: E402
from jaxlag._model._input_signals import ZeroOrderHold as ZeroOrderHold  # noqa: E402
from jaxlag._model._named import named as named  # noqa: E402
from jaxlag._model._quasi_velocities import QuasiVelocities as QuasiVelocities  # noqa: E402
from jaxlag._simulation._lyapunov import GradientGrowth as GradientGrowth  # noqa: E402
from jaxlag._simulation._lyapunov import grad_growth as grad_growth  # noqa: E402
from jaxlag._simulation._simulate import simulate as simulate  # noqa: E402
from jaxlag._simulation._solution import Solution as Solution  # noqa: E402
from jaxlag._statics._assemble import Assembly as Assembly  # noqa: E402
from jaxlag._statics._assemble import assemble as assemble  # noqa: E402
from jaxlag._statics._equilibrium import Equilibrium as Equilibrium  # noqa: E402
from jaxlag._statics._equilibrium import equilibrium as equilibrium  # noqa: E402
from jaxlag._statics._inverse_dynamics import inverse_dynamics as inverse_dynamics  # noqa: E402
from jaxlag._statics._inverse_dynamics import prescribed_motion as prescribed_motion  # noqa: E402
from jaxlag._system._system import System as System  # noqa: E402

__version__ = _version("jaxlag")
