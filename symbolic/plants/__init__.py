"""Plants ready to use, in files by what they are."""

from obsynth.symbolic.plants.bicycle import bicycle
from obsynth.symbolic.plants.driving import cruise_control, kinematic_bicycle, pvtol
from obsynth.symbolic.plants.electric import battery, dc_motor, surface_pmsm
from obsynth.symbolic.plants.exothermic_cstr import exothermic_cstr
from obsynth.symbolic.plants.haldane_bioreactor import haldane_bioreactor
from obsynth.symbolic.plants.hinf_example import hinf_example
from obsynth.symbolic.plants.induction_motor import induction_motor
from obsynth.symbolic.plants.interval_example import interval_example
from obsynth.symbolic.plants.leaking_tanks import leaking_tanks
from obsynth.symbolic.plants.lorenz import lorenz
from obsynth.symbolic.plants.planar_arm import planar_arm, planar_arm_bias, planar_arm_terms
from obsynth.symbolic.plants.pmsm_dq import pmsm_dq
from obsynth.symbolic.plants.process import heat_exchanger, klatt_engell_reactor, tanks_in_a_row
from obsynth.symbolic.plants.qpv_example import qpv_example
from obsynth.symbolic.plants.quadrotor import quadrotor
from obsynth.symbolic.plants.quadruple_tank import quadruple_tank
from obsynth.symbolic.plants.swinging import cart_pole, flexible_joint, forced_oscillator
from obsynth.symbolic.plants.three_tanks import three_tanks
from obsynth.symbolic.plants.three_tanks_fdt import three_tanks_fdt
from obsynth.symbolic.plants.van_der_pol import van_der_pol
from obsynth.symbolic.plants.water_tanks import water_tanks

__all__ = [
    "battery",
    "bicycle",
    "cart_pole",
    "cruise_control",
    "dc_motor",
    "exothermic_cstr",
    "flexible_joint",
    "forced_oscillator",
    "haldane_bioreactor",
    "heat_exchanger",
    "hinf_example",
    "induction_motor",
    "interval_example",
    "kinematic_bicycle",
    "klatt_engell_reactor",
    "leaking_tanks",
    "lorenz",
    "planar_arm",
    "planar_arm_bias",
    "planar_arm_terms",
    "pmsm_dq",
    "pvtol",
    "qpv_example",
    "quadrotor",
    "quadruple_tank",
    "surface_pmsm",
    "tanks_in_a_row",
    "three_tanks",
    "three_tanks_fdt",
    "van_der_pol",
    "water_tanks",
]
