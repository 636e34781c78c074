"""Every plant of the zoo, in all its variants."""

import sympy as sp

from obsynth.symbolic import plants

ZOO = {
    "bicycle": plants.bicycle,
    "bicycle with linear tyres": lambda: plants.bicycle("linear"),
    "exothermic_cstr": plants.exothermic_cstr,
    "haldane_bioreactor": plants.haldane_bioreactor,
    "hinf_example": plants.hinf_example,
    "hinf_example as printed": lambda: plants.hinf_example("as_printed"),
    "induction_motor": plants.induction_motor,
    "interval_example": plants.interval_example,
    "lorenz": plants.lorenz,
    "planar_arm 2R": lambda: plants.planar_arm(2),
    "planar_arm 2R hanging": lambda: plants.planar_arm(2, sp.Rational(981, 100)),
    "planar_arm 3R": lambda: plants.planar_arm(3),
    "planar_arm_bias": plants.planar_arm_bias,
    "planar_arm_bias hanging": lambda: plants.planar_arm_bias(3, sp.Rational(981, 100)),
    "pmsm_dq": plants.pmsm_dq,
    "qpv_example": plants.qpv_example,
    "quadrotor": plants.quadrotor,
    "quadruple_tank": plants.quadruple_tank,
    "three_tanks": plants.three_tanks,
    "three_tanks_fdt": plants.three_tanks_fdt,
    "van_der_pol": plants.van_der_pol,
    "water_tanks": plants.water_tanks,
}
