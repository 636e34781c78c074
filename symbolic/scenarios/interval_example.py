"""The scenario of the interval observer's example, with the feedback that it needs."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from obsynth.symbolic.errors import PlantError
from obsynth.symbolic.scenario import Scenario


def interval_example(seed: int | None = 0, steps: int = 200) -> Scenario:
    """Return the scenario of Lamouchi et al., Section 5, in closed loop.

    x_0 = (1, 1, 1), known to lie in [0.5, 1.5]^3; f_k = cos(0.5 k), rho_1 = sin(0.2 k),
    rho_2 = cos(0.1 k). The paper gives no input and the plant is unstable without one; here
    u_k = 1.5 y_1 + 2 y_2. Noise is uniform in +-0.01: first w of shape (steps, 3), then v of
    shape (steps + 1, 2).

    Parameters
    ----------
    seed : int, optional
        Of ``numpy.random.default_rng``; None: no noise.
    steps : int
        N, giving the samples 0..N.

    Returns
    -------
    Scenario

    Raises
    ------
    PlantError
        If steps is less than 1.

    Examples
    --------
    >>> scenario = interval_example(steps=50)
    >>> scenario.faults.shape, scenario.inputs(0, [1.0, 1.0])
    ((51, 1), [3.5])
    """
    if steps < 1:
        raise PlantError(f"steps={steps} is no positive number of steps", steps=steps)
    k = np.arange(steps + 1, dtype=np.float64)
    return Scenario(
        name="interval observer example",
        steps=steps,
        x0=np.ones(3),
        guess=np.ones(3),
        inputs=_feedback,
        faults=np.cos(0.5 * k)[:, None],
        scheduling=np.column_stack([np.sin(0.2 * k), np.cos(0.1 * k)]),
        disturbances=_noise(seed, steps),
        x_range=np.tile([0.5, 1.5], (3, 1)),
    )


def _feedback(k: int, y: Sequence[float]) -> ArrayLike:
    return [1.5 * y[0] + 2.0 * y[1]]


def _noise(seed: int | None, steps: int) -> NDArray[np.float64]:
    noise = np.zeros((steps + 1, 5))
    if seed is not None:
        rng = np.random.default_rng(seed)
        noise[:-1, :3] = rng.uniform(-0.01, 0.01, (steps, 3))
        noise[:, 3:] = rng.uniform(-0.01, 0.01, (steps + 1, 2))
    return noise
