"""Plants ready to use: a text file each, and functions for those that take parameters."""

from collections.abc import Callable
from functools import cache

from obsynth.symbolic.plant import Plant
from obsynth.symbolic.plant_file import PlantText
from obsynth.symbolic.plants.planar_arm import planar_arm, planar_arm_bias, planar_arm_terms
from obsynth.symbolic.plants.tanks_in_a_row import tanks_in_a_row
from obsynth.symbolic.plants.variants import bicycle, hinf_example, leaking_tanks, van_der_pol
from obsynth.symbolic.plants.variants import text as text

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


@cache
def _written(name: str) -> Callable[[], Plant]:
    """Return the function that reads a plant's text, what the text says about it as docstring."""
    told = PlantText(text(name), f"{name}.toml")

    def make() -> Plant:
        return told.plant()

    make.__name__ = make.__qualname__ = name
    make.__doc__ = str(told.data["about"]).strip() + "\n\nReturns\n-------\nPlant"
    return make


def __getattr__(name: str) -> Callable[[], Plant]:
    if name not in __all__:
        raise AttributeError(f"there is no plant {name!r}; plants are {', '.join(__all__)}")
    return _written(name)


def __dir__() -> list[str]:
    return [*__all__, "text"]
