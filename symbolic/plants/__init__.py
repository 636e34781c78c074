"""Plants ready to use, one file each."""

from obsynth.symbolic.plants.bicycle import bicycle
from obsynth.symbolic.plants.exothermic_cstr import exothermic_cstr
from obsynth.symbolic.plants.haldane_bioreactor import haldane_bioreactor
from obsynth.symbolic.plants.hinf_example import hinf_example
from obsynth.symbolic.plants.induction_motor import induction_motor
from obsynth.symbolic.plants.interval_example import interval_example
from obsynth.symbolic.plants.lorenz import lorenz
from obsynth.symbolic.plants.planar_arm import planar_arm, planar_arm_bias, planar_arm_terms
from obsynth.symbolic.plants.pmsm_dq import pmsm_dq
from obsynth.symbolic.plants.qpv_example import qpv_example
from obsynth.symbolic.plants.quadrotor import quadrotor
from obsynth.symbolic.plants.quadruple_tank import quadruple_tank
from obsynth.symbolic.plants.three_tanks import three_tanks
from obsynth.symbolic.plants.three_tanks_fdt import three_tanks_fdt
from obsynth.symbolic.plants.van_der_pol import van_der_pol
from obsynth.symbolic.plants.water_tanks import water_tanks

__all__ = [
    "bicycle",
    "exothermic_cstr",
    "haldane_bioreactor",
    "hinf_example",
    "induction_motor",
    "interval_example",
    "lorenz",
    "planar_arm",
    "planar_arm_bias",
    "planar_arm_terms",
    "pmsm_dq",
    "qpv_example",
    "quadrotor",
    "quadruple_tank",
    "three_tanks",
    "three_tanks_fdt",
    "van_der_pol",
    "water_tanks",
]
