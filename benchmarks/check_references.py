"""Inputs and references of `benchmarks.check_cases`, quoted as a few numbers from those who made them.

Sources: JEOD (repository nasa/jeod at 6550cf4), verif/SIM_dyncomp, inputs and logs of runs 8A to 10D; NESC's comparison of
six-degree-of-freedom simulations (2015), orbital cases 8A and 8B and Atmos_02; DOP853, SciPy's, relative tolerance 3e-14,
written and run apart from this repository.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

MU = 3.986004415e14  # [m^3/s^2] JEOD's; with ...418e14 case 10D ends 0.32 m away
EARTH_RATE = 7.292115e-5  # [rad/s]
DEG = np.pi / 180


class Row(NamedTuple):
    """A reference at a time."""

    t: float  # [s]
    w: Any  # (3,) [rad/s]
    q: Any  # (4,) scalar first, body to inertial
    r: Any = None  # (3,) [m]


class Case(NamedTuple):
    """Inputs and references of a case."""

    name: str
    source: str  # of the references
    orbit: Any  # r (3,) [m], v (3,) [m/s]
    J: Any  # (3, 3) [kg m^2]
    turns: Any  # from LVLH to body: (axis, deg), one after the other, each about the new axis
    relative: bool  # whether it starts at rest against LVLH, or against the stars
    rows: Any  # of `Row`
    spin: Any = (0.0, 0.0, 0.0)  # [rad/s] added to the rate, in body axes
    gradient: float = 0.0
    torque: Any = (0.0, 0.0, 0.0)
    push: Any = (0.0, 0.0, 0.0)


def row(t, w, q, r=None) -> Row:
    """Of a printed state: JEOD's quaternions take inertial to body components, ours are their inverse."""
    return Row(t, np.array(w), np.array(q) * [1, -1, -1, -1], None if r is None else np.array(r))


TYPICAL = (-4292653.41, 955168.47, 5139356.57), (109.649663, -7527.726490, 1484.521489)
ELLIPTICAL = (-4315967.74, 960356.20, 5167269.53), (129.091037, -7491.513855, 1452.515654)
TYPICAL_END = -1024262.411095882, -6151093.565368023, 2599975.06217899
ELLIPTICAL_END = -1051395.223245429, -6116653.272961161, 2626343.274205685
STATION = np.array([[1.02e8, -6.96e6, -5.48e6], [-6.96e6, 0.91e8, 5.9e5], [-5.48e6, 5.9e5, 1.64e8]])
CYLINDER = np.diag([500.0, 12250.0, 12250.0])
PITCHED = (("y", -11.6),)
ROLLED = ("x", 0.0), ("y", 85.0), ("z", 1.0)
THRUST, SPIN, PUSH = (10.0, 0.0, 0.0), (0.0, 0.01 * DEG, 0.0), (1e-3, 0.0, 0.0)
A8 = [
    row(
        28800, (0, 0, 0), (0.2368106365237557, 0.7173117043670278, -0.6140880728910785, 0.2286492509067215), TYPICAL_END
    )
]
A9 = [row(28800, (9.751635347691358e-05, 8.882593782196596e-06, 1.53007486831241e-05),
          (0.7519599906623781, -0.1381383235762205, 0.01275190192580681, 0.6444465571324457))]  # fmt: skip
B9 = [
    row(2040, (-1.37601279156209e-05, -1.122828353510022e-03, -1.133262474248273e-04),
        (0.6502880312060086, 0.5259013570815666, 0.003769582005675771, -0.54821440088845)),
    row(28800, (-7.282187220568775e-04, -8.332384627087039e-04, -2.424925044840342e-04),
        (-0.3170011650039812, -0.5866170655406695, 0.376943289268734, 0.642887576857603)),
]  # fmt: skip
AX, CX = -1.97989570839746e-5, -1.958561461497211e-5  # [rad/s] about the axis of symmetry
A10 = [
    row(60, (AX, -1.115014856239147e-03, -5.121435202569382e-06),
        (0.2751854271549145, -0.3243235255255143, 0.5979749844895994, -0.6793475909995793)),
    row(360, (AX, -1.027293255554629e-03, -2.813516104538906e-05),
        (0.1788129878003422, -0.4294104658991463, 0.6353563545176567, -0.6164047939010749)),
    row(28800, (AX, -1.080027400090759e-03, -7.098670173048437e-04),
        (-0.08088465634744321, 0.6544148616587985, -0.7285587498795035, 0.1854750904614061), TYPICAL_END),
]  # fmt: skip
C10 = [row(28800, (CX, -1.102150420357001e-03, -7.137081527530395e-04),
           (-0.08332889083259998, 0.6498039126072214, -0.7304531874169157, 0.1930008085615794), ELLIPTICAL_END)]  # fmt: skip
D10 = [
    row(14400, (CX, -1.131565052052271e-03, -3.377837099720844e-04),
        (-0.5508704145421849, -0.6756702120334914, 0.09568017344865497, 0.4804756553266498)),
    row(28800, (CX, -1.062058853745821e-03, -6.901638686869954e-04),
        (-0.06340824136898686, 0.6705404150554688, -0.7195671668810134, 0.1690504038757788), ELLIPTICAL_END),
]  # fmt: skip
B8 = [row(28800, (-7.963417068132706e-4, -7.912816280812693e-4, -1.860246400745596e-4),
          (0.347350313481421, 0.5588902518164564, -0.3648292390385433, -0.6587025675458189))]  # fmt: skip
BALL = [row(14400, (0, -1.134454274550824e-3, 0),
            (0.5108830506516284, -0.004150354372842157, 0.4149481261492226, -0.7528607678188008))]  # fmt: skip
B10 = [row(7200, (-1.97989570839723e-5, -9.171951663659142e-4, -1.193389357182653e-4),
           (0.2025891956388057, 0.7455789914505808, -0.6132979507859846, 0.164119495733043))]  # fmt: skip
CASES = (
    Case("8A", "JEOD", TYPICAL, STATION, PITCHED, False, A8),
    Case("8B station", "DOP853", TYPICAL, STATION, PITCHED, True, B8),
    Case("8B sphere", "DOP853", TYPICAL, np.diag([0.4] * 3), PITCHED, True, BALL),
    Case("9A", "JEOD", TYPICAL, STATION, PITCHED, False, A9, torque=THRUST),
    Case("9B", "JEOD", TYPICAL, STATION, PITCHED, True, B9, torque=THRUST),
    Case("9C", "JEOD", TYPICAL, STATION, PITCHED, False, A9, torque=THRUST, push=PUSH),
    Case("9D", "JEOD", TYPICAL, STATION, PITCHED, True, B9, torque=THRUST, push=PUSH),
    Case("10A", "JEOD", TYPICAL, CYLINDER, ROLLED, True, A10, gradient=1.0),
    Case("10B", "DOP853", TYPICAL, CYLINDER, ROLLED, True, B10, gradient=1.0, spin=SPIN),
    Case("10C", "JEOD", ELLIPTICAL, CYLINDER, ROLLED, True, C10, gradient=1.0),
    Case("10D", "JEOD", ELLIPTICAL, CYLINDER, ROLLED, True, D10, gradient=1.0, spin=SPIN),
)
NAMES = [case.name for case in CASES]
STARTS = {  # printed: inertial to body, and the rate
    "8A": row(0, (0, 0, 0), (0.236810636523756, 0.717311704367028, -0.614088072891079, 0.228649250906722)),
    "9B": row(0, (0, -1.134454274550824e-3, 0), (0.236810636523756, 0.717311704367028, -0.614088072891079, 0.228649250906722)),
    "10A": row(0, (AX, -1.134281491669957e-3, 0), (0.294955483457394, -0.301339757137772, 0.587973930051626, -0.690276952480821)),
    "10C": row(0, (CX, -1.122059109806593e-3, 0), (0.294955483664729, -0.301339757054878, 0.587973929969261, -0.690276952498572)),
    "10D": row(0, (CX, -9.47526184607160e-4, 0), (0.294955483664729, -0.301339757054878, 0.587973929969261, -0.690276952498572)),
}  # fmt: skip
BRICK_J = np.diag([0.001894220, 0.006211019, 0.007194665])  # [slug ft^2]; ratios matter alone
BRICK_W = np.array([10.0, 20.0, 30.0])  # [deg/s]
BRICK = {  # t [s]: rate [deg/s]; yaw, pitch, roll [deg] against the frame of the start, DOP853
    1: ((4.258841898653, 23.119942897498, 28.379817775083), (31.77767461, 18.68720975, 12.59374433)),
    10: ((-2.418902221693, -23.552569519561, 28.128592630041), (-4.31861073, 3.74448482, -65.97725002)),
    20: ((-5.422734680068, 22.715930576453, 28.608281747317), (-6.36379157, 4.06909796, 4.22159046)),
    30: ((12.618390775914, -17.397474761612, 31.119588886944), (-4.29769350, -3.81026674, -56.02598213)),
}
# Largest differences of NESC's tools from DOP853 over 30 s, [deg/s] and [deg], as lengths and angles, after the Earth's turn
# is removed: recorded once from their files (repository nasa/simupy-flight at 70754e6); `--nesc FOLDER` measures them again.
RECORDED = {
    "sim_01": (3.6e-10, 3.5e-9, "its initial rates are printed 4e-11 deg/s off"),
    "sim_04": (3.9e-10, 5.2e-9, ""),
    "sim_05": (5.9e-5, 1.2e-4, ""),
    "sim_06": (4.7e-3, 1.0e-2, ""),
    "sim_02": (1.3e-3, 3.7, "its Euler angles do not follow from its own rates"),
}
