"""Differentiable dynamics from a Lagrangian, in JAX."""

# ruff: noqa: E402  XLA is configured before anything is imported that may compile

from importlib.metadata import version as _version

from jaxlag._core import _old_pickles, _xla

_xla.configure()
_old_pickles.install()

from jaxlag import energy as energy
from jaxlag import math as math
from jaxlag import rotation as rotation
from jaxlag import solvers as solvers
from jaxlag import testing as testing
from jaxlag import transforms as transforms
from jaxlag._analysis._descriptor_form import DescriptorForm as DescriptorForm
from jaxlag._analysis._descriptor_form import descriptor_form as descriptor_form
from jaxlag._analysis._linearization import Linearization as Linearization
from jaxlag._analysis._linearize import linearize as linearize
from jaxlag._analysis._linearize_along import LinearizedMotion as LinearizedMotion
from jaxlag._analysis._linearize_along import linearize_along as linearize_along
from jaxlag._analysis._modes import Modes as Modes
from jaxlag._analysis._modes import modes as modes
from jaxlag._analysis._steady import steady as steady
from jaxlag._analysis._steady_motion import SteadyMotion as SteadyMotion
from jaxlag._core._arguments import former_names as _former_names
from jaxlag._core._errors import AssemblyError as AssemblyError
from jaxlag._core._errors import EquilibriumError as EquilibriumError
from jaxlag._core._errors import SimulationError as SimulationError
from jaxlag._core._status import Status as Status
from jaxlag._fit._descent import Descent as Descent
from jaxlag._fit._experiment import Experiment as Experiment
from jaxlag._fit._fit import fit as fit
from jaxlag._fit._fit_result import FitResult as FitResult
from jaxlag._fit._free_parameters import Prior as Prior
from jaxlag._fit._predict import Prediction as Prediction
from jaxlag._fit._predict import predict as predict
from jaxlag._fit._select_model import Candidate as Candidate
from jaxlag._fit._select_model import ModelSelection as ModelSelection
from jaxlag._fit._select_model import select_model as select_model
from jaxlag._gradient._modes import GradientMode as GradientMode
from jaxlag._model._constraints import Baumgarte as Baumgarte
from jaxlag._model._constraints import Holonomic as Holonomic
from jaxlag._model._constraints import Pfaffian as Pfaffian
from jaxlag._model._forces import GeneralizedForce as GeneralizedForce
from jaxlag._model._forces import PointForce as PointForce
from jaxlag._model._forces import Rayleigh as Rayleigh
from jaxlag._model._forces import Torque as Torque
from jaxlag._model._input_signals import Feedback as Feedback
from jaxlag._model._input_signals import LinearInterpolation as LinearInterpolation
from jaxlag._model._input_signals import TimeFunction as TimeFunction
from jaxlag._model._input_signals import ZeroOrderHold as ZeroOrderHold
from jaxlag._model._named import named as named
from jaxlag._model._quasi_velocities import QuasiVelocities as QuasiVelocities
from jaxlag._model._states import States as States
from jaxlag._simulation._lyapunov import lyapunov as lyapunov
from jaxlag._simulation._perturbation_growth import PerturbationGrowth as PerturbationGrowth
from jaxlag._simulation._simulate import simulate as simulate
from jaxlag._simulation._solution import Solution as Solution
from jaxlag._simulation._step import step as step
from jaxlag._statics._assemble import assemble as assemble
from jaxlag._statics._assembly import Assembly as Assembly
from jaxlag._statics._equilibrium import Equilibrium as Equilibrium
from jaxlag._statics._equilibrium import equilibrium as equilibrium
from jaxlag._statics._inverse_dynamics import inverse_dynamics as inverse_dynamics
from jaxlag._statics._inverse_dynamics import prescribed_motion as prescribed_motion
from jaxlag._sweep._case import Case as Case
from jaxlag._sweep._replay import replay as replay
from jaxlag._sweep._statistics import Reduction as Reduction
from jaxlag._sweep._statistics import Statistics as Statistics
from jaxlag._sweep._sweep import sweep as sweep
from jaxlag._sweep._sweep_result import StoredSweep as StoredSweep
from jaxlag._sweep._sweep_result import SweepResult as SweepResult
from jaxlag._sweep._sweep_result import open_sweep as open_sweep
from jaxlag._system._system import System as System

__version__ = _version("jaxlag")

_RENAMED = {
    "Couple": "Torque",
    "Linear": "LinearInterpolation",
    "Function": "TimeFunction",
    "Positive": "transforms.Positive",
    "Bounded": "transforms.Bounded",
    "SPD": "transforms.SPD",
    "Inertia": "transforms.Inertia",
    "PseudoInertia": "transforms.PseudoInertia",
    "compare": "select_model",
    "Comparison": "ModelSelection",
    "grad_growth": "lyapunov",
    "GradientGrowth": "PerturbationGrowth",
}

__getattr__ = _former_names(__name__, _RENAMED)
