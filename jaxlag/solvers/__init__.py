"""Solvers of ordinary differential equations, for `simulate` and for diffrax."""

from jaxlag.solvers._dopri5 import Dopri5 as Dopri5
from jaxlag.solvers._dopri8 import Dopri8 as Dopri8
from jaxlag.solvers._explicit import AbstractExplicit as AbstractExplicit
from jaxlag.solvers._explicit import AbstractRungeKutta as AbstractRungeKutta
from jaxlag.solvers._fixed import AbstractFixedStep as AbstractFixedStep
from jaxlag.solvers._nystrom12 import Nystrom12 as Nystrom12
from jaxlag.solvers._partitioned import AbstractPartitioned as AbstractPartitioned
from jaxlag.solvers._partitioned import GaussLegendre as GaussLegendre
from jaxlag.solvers._partitioned import LobattoIIIAB as LobattoIIIAB
from jaxlag.solvers._prince9 import Prince9 as Prince9
from jaxlag.solvers._splitting import Splitting as Splitting
from jaxlag.solvers._tsit5 import Tsit5 as Tsit5
