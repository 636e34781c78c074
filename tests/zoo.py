"""Every plant of the zoo, in all its variants, and the plants of the general class."""

import sympy as sp

from obsynth.symbolic import plants

ZOO = {
    "bicycle with linear tyres": lambda: plants.bicycle("linear"),
    "bicycle": plants.bicycle,
    "exothermic_cstr": plants.exothermic_cstr,
    "haldane_bioreactor": plants.haldane_bioreactor,
    "hinf_example as printed": lambda: plants.hinf_example("as_printed"),
    "hinf_example": plants.hinf_example,
    "induction_motor": plants.induction_motor,
    "interval_example": plants.interval_example,
    "lorenz": plants.lorenz,
    "planar_arm 2R hanging": lambda: plants.planar_arm(2, sp.Rational(981, 100)),
    "planar_arm 2R": lambda: plants.planar_arm(2),
    "planar_arm 3R": lambda: plants.planar_arm(3),
    "planar_arm_bias hanging": lambda: plants.planar_arm_bias(3, sp.Rational(981, 100)),
    "planar_arm_bias": plants.planar_arm_bias,
    "pmsm_dq": plants.pmsm_dq,
    "qpv_example": plants.qpv_example,
    "quadrotor": plants.quadrotor,
    "quadruple_tank": plants.quadruple_tank,
    "three_tanks": plants.three_tanks,
    "three_tanks_fdt": plants.three_tanks_fdt,
    "van_der_pol": plants.van_der_pol,
    "water_tanks": plants.water_tanks,
}

GALLERY = {
    "battery": plants.battery,
    "cart_pole": plants.cart_pole,
    "cruise_control": plants.cruise_control,
    "dc_motor": plants.dc_motor,
    "flexible_joint": plants.flexible_joint,
    "forced_oscillator": plants.forced_oscillator,
    "heat_exchanger": plants.heat_exchanger,
    "kinematic_bicycle": plants.kinematic_bicycle,
    "klatt_engell_reactor": plants.klatt_engell_reactor,
    "leaking_tanks": plants.leaking_tanks,
    "pvtol": plants.pvtol,
    "surface_pmsm": plants.surface_pmsm,
    "tanks_in_a_row": plants.tanks_in_a_row,
}
"""Gains and outputs that depend on states, feedthrough, no rest: no split, as papers have it."""
