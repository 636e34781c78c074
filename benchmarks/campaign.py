"""A campaign: 200 seeds of 100,000 instants of the four tanks, in two processes.

python benchmarks/campaign.py [seeds] [instants]
"""

import sys
import time

import numpy as np

import obsynth as ob

LIMIT = 120.0
"""Seconds for 200 seeds of 100,000 instants."""


def main() -> None:
    """Print seconds, microseconds an instant, and what was found."""
    seeds, steps = (int(a) for a in (*sys.argv[1:3], 200, 100_000)[:2])
    plant = ob.plants.quadruple_tank().discretise("euler", Ts=1)
    observer = ob.BoundedErrorUIO(bounds="peak").design(plant)
    rest = ob.equilibrium(plant)
    faults = 0.5 * np.sin(np.outer(np.arange(steps + 1), [0.01, 0.02]))
    inputs = np.tile(rest.u, (steps + 1, 1))
    scenario = ob.Scenario(
        "waves", steps, rest.x, rest.x, inputs, faults, f_range=[[-0.5, 0.5]] * 2
    )
    ob.campaign(observer, scenario, 1, workers=1)  # compiled once, before the clock runs
    start = time.perf_counter()
    found = ob.campaign(observer, scenario, seeds, workers=2)
    seconds = time.perf_counter() - start
    print(found.table())
    each = 1e6 * seconds / (seeds * (steps + 1))
    print(f"{seeds} runs of {steps} instants: {seconds:.1f} s, {each:.2f} us an instant")
    if (seeds, steps) == (200, 100_000):
        print(f"under {LIMIT:.0f} s: {'met' if seconds < LIMIT else 'not met'}")


if __name__ == "__main__":
    main()
