"""The fault scenario of the H-infinity example."""

from typing import Any, Literal

import numpy as np

from obsynth.symbolic.scenario import Scenario, known_name

_NAMES = ("nominal", "disturbed", "noise")


def hinf_example(name: Literal["nominal", "disturbed", "noise"] = "nominal") -> Scenario:
    """Return the scenario of Witczak, Korbicz and Jozefowicz, (54)-(56), over 500 steps.

    u = sin(.002 pi k), f = 1 for 200 <= k <= 300.

    Parameters
    ----------
    name : {"nominal", "disturbed", "noise"}
        ``"nominal"``: w = 0, x0 = (3, 2, 1), guess 0, Figs. 2 and 3.
        ``"disturbed"``: w = .1 (sin 1.3 k, cos 2.1 k, sin(.7 k + 1)), guess x0.
        ``"noise"``: w from N(0, .1^2 I) by the seed of the simulation, guess x0, Fig. 1.

    Returns
    -------
    Scenario

    Raises
    ------
    PlantError
        Another name.

    Examples
    --------
    >>> hinf_example().faults[[199, 200, 300, 301], 0].tolist()
    [0.0, 1.0, 1.0, 0.0]
    """
    known_name(name, _NAMES, "the H-infinity example has")
    steps = 500
    k = np.arange(steps + 1, dtype=np.float64)
    waves = np.column_stack([np.sin(1.3 * k), np.cos(2.1 * k), np.sin(0.7 * k + 1.0)])
    x0 = np.array([3.0, 2.0, 1.0])
    disturbances: dict[str, Any] = {
        "nominal": np.zeros((steps + 1, 3)),
        "disturbed": 0.1 * waves,
        "noise": _noise,
    }
    return Scenario(
        name=name,
        steps=steps,
        x0=x0,
        guess=np.zeros(3) if name == "nominal" else x0,
        inputs=np.sin(0.002 * np.pi * k)[:, None],
        faults=((k >= 200) & (k <= 300)).astype(np.float64)[:, None],
        disturbances=disturbances[name],
    )


def _noise(rng: np.random.Generator, k: int) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    return 0.1 * rng.standard_normal(3)
