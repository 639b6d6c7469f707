"""Dormand, El-Mikkawy and Prince's method of order 12 for second-order equations."""

from collections.abc import Callable
from typing import Any, ClassVar

import diffrax
import numpy as np

from jaxlag._core._errors import invalid
from jaxlag.solvers._explicit import AbstractExplicit, tableau_of
from jaxlag.solvers._stages import Attempt, nystrom, nystrom_in_loop
from jaxlag.solvers._tableau import Tableau, strictly_lower
from jaxlag.solvers._unweighted_stages import unweighted_stages

# fmt: off

# Coefficients of h^2 a_j in the coordinates of the stages 2 to 17.
_A = (
    (0.0002,),
    (0.0002666666666666667, 0.0005333333333333334),
    (0.002916666666666667, -0.004166666666666667, 0.00625),
    (0.0016460905349794238, 0, 0.0054869684499314125, 0.0017558299039780521),
    (0.0019456, 0, 0.007151746031746032, 0.0029127111111111113, 0.0007899428571428571),
    (0.00056640625, 0, 0.0008809730489417989, -0.0004369212962962963, 0.00033900669642857143,
     -9.946469907407407e-05),
    (0.0030833333333333333, 0, 0, 0.0017777777777777779, 0.0027, 0.0015782828282828283,
     0.01086060606060606),
    (0.00365183937480113, 0, 0.003965171714072343, 0.0031972582629306284,
     0.008221467306855435, -0.0013130926959572379, 0.009771586968064868, 0.003755769069232834),
    (0.003707241068718501, 0, 0.005082045854555286, 0.001174708002175412,
     -0.021147629915126993, 0.06010463698107881, 0.02010573476850619, -0.02835075012293358,
     0.014879568918581932),
    (0.03512537656073344, 0, -0.008615749195138479, -0.005791448051007917, 1.945554823782616,
     -3.4351238674565137, -0.10930701107475221, 2.3496383118995166, -0.7560094086870229,
     0.10952897222156927),
    (0.020527792537482496, 0, -0.00728644676448018, -0.0021153556079618403,
     0.9275807968723522, -1.6522824844257367, -0.02107956300568657, 1.2065364326207872,
     -0.4137144770010661, 0.09079873982809654, 0.005355552600533985),
    (-0.14324078875545515, 0, 0.012528703773091817, 0.006826019163969827, -4.799555395574387,
     5.6986250439519415, 0.7553430369523645, -0.12755487858281084, -1.9605926051117384,
     0.9185609056635262, -0.23880085505284432, 0.15911081357234216),
    (0.8045019205520489, 0, -0.016658527067011247, -0.021415834042629735, 16.827235928962466,
     -11.172835357176098, -3.377159297226324, -15.243326655360846, 17.179835738215417,
     -5.437719239823995, 1.3878671618364655, -0.5925827732652812, 0.029603873171297354),
    (-0.913296766697358, 0, 0.0024112725757805178, 0.01765812269386174, -14.851649779720384,
     2.1589708670045757, 3.99791558311788, 28.434151800232232, -25.2593643549416,
     7.733878542362238, -1.8913028948478674, 1.0014845070224718, 0.004641199599109052,
     0.011218755022148957),
    (-0.27519629720559396, 0, 0.03661188877915492, 0.009789519688231562, -12.293062345886211,
     14.207226453937903, 1.5866476906789537, 2.4577735327595946, -8.935193694403273,
     4.373672731613407, -1.8347181765449492, 1.1592085289061491, -0.017290253165383924,
     0.019325977904460768, 0.005204442937554993),
    (1.3076391847404059, 0, 0.017364109189745843, -0.018544456454265796, 14.811522032867726,
     9.38317630848247, -5.2284261999445425, -48.95128052584765, 38.297096034337926,
     -10.58738133697598, 2.4332304376226275, -1.0453406042575444, 0.0717732095086726,
     0.0021622109708082783, 0.007009595759602514, 0),
)

_C = (
    1 / 50, 1 / 25, 1 / 10, 2 / 15, 4 / 25, 1 / 20, 1 / 5, 1 / 4, 1 / 3, 1 / 2, 5 / 9, 3 / 4, 6 / 7,
    8437 / 8926, 1.0, 1.0,
)

# Weights of a_j in the velocity, of order 12 and of order 10; (1 - c_j) times them are those in
# the coordinates.
_B = (
    0.012127868517185414, 0, 0, 0, 0, 0, 0.09083943422704079, 0.3156836976483934,
    -0.2632249065769097, 0.3047803786184589, -0.041551616155429835, 0.2467756096762953,
    0.15226053010586602, 0.08143848163026961, 0.08502571193890811, -0.009155189630077963, 0.025,
)
_LOWER = (
    0.01700870190700699, 0, 0, 0, 0, 0, 0.07606245887455937, 0.4650327216584413,
    -0.5357615266790714, 0.5031826024520275, -0.26261300215066363, 0.4262217898861095,
    0.10736320816011619, 0.11413965924142547, 0.06936338665004868, 0.02, 0,
)

# fmt: on


class Nystrom12(AbstractExplicit):
    """Order 12 with an embedded method of order 10, 17 stages, for accelerations without v.

    k_i = a(t + c_i h, q + h c_i v + h^2 sum_{j<i} a_ij k_j),

        q1 = q + h v + h^2 sum_i (1 - c_i) b_i k_i,    v1 = v + h sum_i b_i k_i;

    the error estimates are the differences from the same sums with the weights of order 10. A
    Runge-Kutta method of order 12 takes 25 stages: here conditions of order for changes of v within
    a step are void. But every stage waits for the acceleration of the stage before it; in Nystrom's
    form of a Runge-Kutta method the coordinates do not depend on it.

    In `simulate` it takes systems whose accelerations do not depend on v: L = T(v) - V(t, q) with
    a constant mass matrix and forces Q(t, q), without constraints. In `diffrax.diffeqsolve` y is a
    pair (q, v) of pytrees, `vf(t, y, args)` the pair (v, a), and a must not depend on v: this is
    not checked there.

    Source: Dormand, El-Mikkawy, Prince, High-order embedded Runge-Kutta-Nystrom formulae, IMA J.
    Numer. Anal. 7 (1987), RKN12(10)17M.
    """

    interpolation_cls: ClassVar[Callable] = diffrax.ThirdOrderHermitePolynomialInterpolation.from_k

    @property
    def coefficients(self) -> Tableau:
        """Those of the paper."""
        c, b = np.array(_C), np.array(_B)
        e, left = b - np.array(_LOWER), 1.0 - np.array([0.0, *_C])
        rows = strictly_lower(_A)
        return Tableau(None, c, b, e, rows, left * b, left * e, False, unweighted_stages(b, e))

    def order(self, terms: Any) -> int:
        """Order of the step."""
        return 12

    def error_order(self, terms: Any) -> int:
        """The estimate is that of a method of order 10."""
        return 11

    def attempt(
        self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any, solver_state: Any, made_jump: Any
    ) -> Attempt:
        """One step."""
        if not getattr(terms, "second_order", not hasattr(terms, "sections")):
            was = "it contained quasi-velocities, work or states of its own"
            raise invalid("Nystrom12: y", "be (q, v) alone", was, "Choose 'dopri8'.")
        stages = nystrom_in_loop if self.looped else nystrom
        return stages(tableau_of(type(self)), terms, t0, t1, y0, None, True, args)
