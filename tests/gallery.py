"""The twelve plants of the gallery, typed as their authors do, with the sample times they take."""

TIMES = {
    "cruise_control": 0.1,
    "pvtol": 0.02,
    "cart_pole": 0.01,
    "flexible_joint": 0.01,
    "dc_motor": 0.01,
    "battery": 1.0,
    "kinematic_bicycle": 0.05,
    "heat_exchanger": 0.2,
    "surface_pmsm": 1e-4,
    "klatt_engell_reactor": 0.001,
    "forced_oscillator": 0.01,
    "tanks_in_a_row": 0.5,
}
"""In s, of the reactor in h."""
