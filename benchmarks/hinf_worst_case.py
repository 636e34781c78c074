"""Is a certified level ever exceeded, and how much of it does a search for the worst case reach?

Random stable plants with sector nonlinearities, one fault each; every form of `HinfUIO` in turn;
the adversarial search against what the certificate proves. Prints one table.

Usage: python benchmarks/hinf_worst_case.py [number of plants, 1000]
"""

import sys
import time
from collections import Counter

import numpy as np
import sympy as sp

import obsynth as ob
from obsynth.designs import SolverTrouble

METHODS = {
    "one multiplier": ob.HinfUIO(),
    "per row": ob.HinfUIO(multipliers="per_row"),
    "per entry": ob.HinfUIO(multipliers="per_entry"),
    "polytopic": ob.HinfUIO(method="polytopic"),
    "general": ob.HinfUIO(method="general"),
    "(45)": ob.HinfUIO(form="printed"),
}
SECTORS = (sp.sin, sp.tanh, sp.atan)


def random_plant(seed, largest=4):
    """Return a stable plant whose nonlinearities have slopes in a sector."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, largest + 1))
    m = int(rng.integers(1, n + 1))
    A = rng.standard_normal((n, n))
    A *= rng.uniform(0.2, 0.9) / np.abs(np.linalg.eigvals(A)).max()
    C = np.eye(n)[rng.permutation(n)[:m]] + 0.3 * rng.standard_normal((m, n))
    L, W = rng.standard_normal((n, 1)), rng.standard_normal((n, int(rng.integers(1, n + 1))))
    plant = ob.Plant(f"random {seed}")
    x = plant.states(f"x1:{n + 1}", range=(-20, 20))
    # Inputs in every equation: the search may hold the plant wherever it likes.
    u = plant.inputs(f"u1:{n + 1}", range=(-100, 100), nominal=0)
    (f,) = plant.faults("f")
    w = plant.disturbances(f"w1:{W.shape[1] + 1}")
    rows = []
    for i in range(n):
        linear = sum(a * s for a, s in zip(A[i], x, strict=True))
        noise = sum(a * s for a, s in zip(W[i], w, strict=True))
        rows.append(linear + u[i] + L[i, 0] * f + noise)
    for i in rng.permutation(n)[: rng.integers(1, n + 1)]:
        sector = SECTORS[rng.integers(len(SECTORS))]
        size, scale = rng.uniform(0.02, 0.3), rng.uniform(0.5, 2.0)
        parts = rng.permutation(n)[: rng.integers(1, 3)]
        argument = sum(float(rng.choice([-1.0, 1.0])) * x[j] for j in parts)
        rows[i] += size / scale * sector(scale * argument)
    plant.dynamics(rows, Ts=1)
    plant.outputs([sum(c * s for c, s in zip(row, x, strict=True)) for row in C])
    return plant


def measure(seed, methods=METHODS, steps=4000, points=64, largest=4):
    """Return (form, certified, found, limit), or (form, why there is no design)."""
    name = list(methods)[seed % len(methods)]
    try:
        observer = methods[name].design(random_plant(seed, largest))
    except (ob.StructureError, ob.InfeasibleDesign, SolverTrouble) as refusal:
        return name, type(refusal).__name__
    found = ob.worst_case(observer, steps=steps, points=points)
    return name, found.certified, found.gain, found.limit


def main(count):
    """Run and print."""
    start, refused, rows = time.time(), Counter(), {name: [] for name in METHODS}
    for seed in range(count):
        name, *outcome = measure(seed)
        if len(outcome) == 1:
            refused[outcome[0]] += 1
            if outcome[0] == "SolverTrouble":
                print(f"plant {seed}, {name}: no solver solved it")
        else:
            rows[name].append(outcome)
    print(f"{count} plants in {time.time() - start:.0f} s; refused: {dict(refused)}")
    print(f"{'form':<16}{'designs':>8}{'exceeded':>10}{'reached, median':>17}{'best':>8}")
    for name, outcomes in rows.items():
        if not outcomes:
            continue
        certified, found, _ = np.array(outcomes).T
        share = found / certified
        print(
            f"{name:<16}{len(outcomes):>8}{int((share > 1).sum()):>10}"
            f"{100 * np.median(share):>15.1f} %{100 * share.max():>6.1f} %"
        )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 1000)
