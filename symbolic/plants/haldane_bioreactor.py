"""A continuous bioreactor with substrate inhibition."""

import sympy as sp

from obsynth.symbolic.plant import Plant


def haldane_bioreactor() -> Plant:
    """Return the chemostat with the growth rate of Haldane (Andrews).

    X' = (mu - D) X, S' = D (S_f - S) - mu X / Y with mu = mu_max S / (k_m + S + k_1 S^2). At the
    nominal dilution of 0.3 1/h there are three steady states: washout (0, 4), a saddle near
    (0.995, 1.512) and a stable node near (1.530, 0.1746).

    Returns
    -------
    Plant
        Continuous; biomass X and substrate S in g/L, dilution D in 1/h; both concentrations
        are measured, S with a sensor fault. The parameters are per hour as in the source, the
        derivatives per second.

    References
    ----------
    Bequette: Process Dynamics: Modeling, Analysis and Simulation, Module 8 (biochemical
    reactors), substrate inhibition: mu_max = 0.53, k_m = 0.12, k_1 = 0.4545, Y = 0.4, S_f = 4.

    Examples
    --------
    >>> plant = haldane_bioreactor()
    >>> plant.constant_values[sp.Symbol("k_1", real=True)]
    909/2000
    """
    R = sp.Rational
    plant = Plant("Haldane bioreactor")
    X, S = plant.states("X S", range=[(0, 2), (0, 4)], nominal=[1.5, 0.2], unit="g/L")
    (D,) = plant.inputs("D", range=(0, 0.6), nominal=0.3, unit="1/h")
    plant.sensor_faults("s", of="y2", range=(-0.2, 0.2))
    v = plant.disturbances("v1:3", bound=0.01, unit="g/L")
    (fastest,) = plant.params("mu_max", R(53, 100), unit="1/h")
    (half,) = plant.params("k_m", R(12, 100), unit="g/L")
    (inhibition,) = plant.params("k_1", R(4545, 10**4), unit="L/g")
    (yield_,) = plant.params("Y", R(2, 5))
    (feed,) = plant.params("S_f", 4, unit="g/L")
    growth = fastest * S / (half + S + inhibition * S**2)
    plant.dynamics(
        [
            (growth - D) * X * R(1, 3600),
            (D * (feed - S) - growth * X / yield_) * R(1, 3600),
        ]
    )
    plant.outputs([X + v[0], S + v[1]], unit="g/L")
    return plant
