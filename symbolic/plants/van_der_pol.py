"""The van der Pol oscillator."""

from typing import Any

from obsynth.symbolic.plant import Plant


def van_der_pol(mu: Any = 1) -> Plant:
    """Return the forced van der Pol oscillator x1' = x2, x2' = mu (1 - x1^2) x2 - x1 + u.

    Parameters
    ----------
    mu : number or SymPy number
        Damping; 1 by default.

    Returns
    -------
    Plant
        Continuous, without units; x1 is measured, the input u has an additive fault f. The box
        (-3, 3)^2 contains the limit cycle of mu = 1; the origin is an unstable equilibrium.

    References
    ----------
    van der Pol: On relaxation oscillations, Philosophical Magazine 2(11), 1926.

    Examples
    --------
    >>> van_der_pol().rhs[1]
    f + mu*x2*(1 - x1**2) + u - x1
    """
    plant = Plant("van der Pol oscillator")
    x1, x2 = plant.states("x1 x2", range=(-3, 3), nominal=0)
    (u,) = plant.inputs("u", range=(-1, 1), nominal=0)
    plant.actuator_faults("f", of=u, range=(-0.5, 0.5))
    (damping,) = plant.params("mu", mu)
    plant.dynamics([x2, damping * (1 - x1**2) * x2 - x1 + u])
    plant.outputs([x1])
    return plant
