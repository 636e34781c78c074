"""A scenario for any plant: from its nominal state, with faults that move as far as they may."""

import numpy as np

from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.plant import Plant
from obsynth.symbolic.scenario import Scenario


def gentle(plant: Plant, steps: int = 200, seed: int = 0, share: float = 0.05) -> Scenario:
    """Return a seeded scenario about the nominal values of any plant.

    Parameters
    ----------
    plant : Plant
        Continuous or discrete; faults keep to their rates where the plant is discrete.
    steps : int
        Number of samples.
    seed : int
        Of the first state, the guess, and the phases of inputs and faults.
    share : float
        Of the half ranges: how far the first state, inputs and faults go from their nominal values.
        Unstable plants leave their box in some time whatever it is.

    Returns
    -------
    Scenario
        Waves of inputs and faults, unknown inputs in the middle of their ranges or zero,
        disturbances uniform in their box.

    Raises
    ------
    PlantError
        If the plant is incomplete.

    Notes
    -----
    Nothing is known of the plant but its ranges: a state or fault without one begins, and stays, at
    its nominal value or zero, a disturbance at zero.

    Examples
    --------
    >>> from obsynth.symbolic.plants import cruise_control
    >>> gentle(cruise_control(), steps=50).steps
    50
    """
    plant.check()
    rng = np.random.default_rng(seed)
    x_middle, x_half = _about(plant, "x", share)
    u_middle, u_half = _about(plant, "u", share)
    f_middle, f_half = _about(plant, "f", share)
    speed = 2.0 * np.pi / steps
    rates = [np.inf if s.rate is None else float(s.rate) for s in plant.f]
    # a wave a sin(speed k + phase) moves by less than a speed from one sample to the next
    still = np.array([0.0 if s.constant else r for s, r in zip(plant.f, rates, strict=True)])
    f_half = np.minimum(f_half, still / speed) if plant.Ts is not None else f_half
    u_phase, f_phase = (rng.uniform(0.0, 2.0 * np.pi, len(v)) for v in (u_half, f_half))
    k = np.arange(steps + 1)[:, None]
    w_box = plant.box("w").reshape(-1, 2)
    w_low, w_high = np.where(np.isfinite(w_box).all(axis=1, keepdims=True), w_box, 0.0).T
    return Scenario(
        name=f"gentle {seed}",
        steps=steps,
        x0=x_middle + x_half * rng.uniform(-1.0, 1.0, len(x_half)),
        guess=x_middle,
        inputs=u_middle + u_half * np.sin(3.0 * speed * k + u_phase),
        faults=f_middle + f_half * np.sin(speed * k + f_phase),
        unknown_inputs=_about(plant, "d", share)[0] + 0.0 * k if plant.d else None,
        x_range=None,
        disturbances=lambda rng, k: rng.uniform(w_low, w_high),
        f_range=_first_faults(plant, f_middle, f_half),
    )


def _first_faults(plant: Plant, middle: FloatArray, half: FloatArray) -> FloatArray | None:
    """Return the ranges of the faults, what the waves take where there is none; None of none."""
    if not plant.f:
        return None
    near = np.column_stack([middle - half, middle + half])
    box = plant.box("f")
    return np.where(np.isfinite(box), box, near)


def _about(plant: Plant, kind: str, share: float) -> tuple[FloatArray, FloatArray]:
    """Return nominal values, clipped so that a share of the half range about them is allowed."""
    box = plant.box(kind).reshape(-1, 2)
    signals = getattr(plant, kind)
    bounded = np.array([s.bounded for s in signals], dtype=bool)
    low, high = np.where(bounded[:, None], box, 0.0).T
    half = share * 0.5 * (high - low)
    middle = [0.0 if kind == "f" else s.usual for s in signals]
    kept = np.where(bounded, np.clip(middle, low + half, high - half), middle)
    return np.asarray(kept, dtype=float), half
