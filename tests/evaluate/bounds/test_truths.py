"""Nothing that happened is refuted: records whose trajectories are known in 400 bits.

Mistakes that are seen here: noise rows or boxes of half the size, an instant after the record held
to the ranges of states, bounds declared proved that are none, a certificate that takes the other
end, no proof of emptiness, an upper bound that its own trajectory does not attain.
"""

from fractions import Fraction

import mpmath as mp
import numpy as np
import pytest
from exactly import BITS
from witness import PLANTS, exact_of, happened

from obsynth.evaluate.bounds.boxes import enclose
from obsynth.evaluate.bounds.certified import least, narrowed
from obsynth.evaluate.bounds.least_bounds import LeastBounds
from obsynth.evaluate.bounds.problem import pose


def asked(truth):
    """The problem and the bounds of its groups that are declared, which the truth keeps."""
    problem = pose(truth.plant, truth.record, truth.free)
    declared = LeastBounds(problem, truth.record, 1.2, None)._declared
    return problem, np.array([*declared.values()])


def lost(problem, bounds, path):
    """Signals of the truth that are outside of their boxes."""
    boxes = enclose(problem, bounds)
    assert boxes.empty is None
    return [
        (k, problem.names[j])
        for k, v in enumerate(path)
        for j, value in enumerate(v)
        if not mp.mpf(boxes.ends[k, j, 0]) <= value <= mp.mpf(boxes.ends[k, j, 1])
    ]


def replayed(name, truth, fit):
    """By how much the trajectory of a fit misses equations, readings, ranges, rates and bounds."""
    exactly, call, _ = exact_of(name)
    plant, problem, v = exactly.plant, fit.problem, fit.least.trajectory.v
    n, missed = len(plant.x), 0.0
    values = {s.name: s.value for s in truth.plant.constants}
    parts = [problem.places[kind] for kind in ("x", "d", "f", "w", "p")]
    with mp.workprec(BITS):
        for k in range(len(v)):
            x, d, f, w, p = ([mp.mpf(a) for a in v[k, part]] for part in parts)
            u = [mp.mpf(a) for a in truth.record.u[k]]
            if len(p) < len(plant.p):  # they have a value here
                p = [mp.mpf(a.p) / a.q for a in (values[s.name] for s in plant.p)]
            rows = call(*x, *u, *d, *f, *w, *p)
            after = v[k + 1, :n] if k + 1 < len(v) else []
            told = truth.record.y[k]
            gaps = [abs(a - b) for a, b in zip(rows, after, strict=False)]
            gaps += [abs(a - b) for a, b in zip(rows[n:], told, strict=True) if np.isfinite(b)]
            missed = max(missed, *map(float, gaps), 0.0)
    box = problem.box.copy()
    sizes = problem.sizes(fit.least.trajectory.bounds)
    w = problem.places["w"]
    box[w] = np.column_stack([problem.middle - sizes, problem.middle + sizes])
    outside = np.maximum(box[:, 0] - v, v - box[:, 1]).max()
    rates = [np.inf if r is None else r for r in exactly.rates]
    moved = np.abs(np.diff(v[:, problem.places["f"]], axis=0)) - np.array(rates, float)
    apart = np.abs(np.diff(v[:, problem.still], axis=0)).max(initial=0.0)
    return missed, outside, moved.max(initial=-1.0), apart


def hold(name, seed, steps=24):
    """Everything that is claimed of a record, of which the truth is a witness."""
    truth = happened(name, seed, steps)
    problem, declared = asked(truth)
    assert not lost(problem, declared, truth.v)
    rng = np.random.default_rng(seed)
    weights = rng.uniform(0.1, 1.0, len(declared)) / declared
    fit = LeastBounds(problem, truth.record, 1.2, least(problem, weights))
    needed = sum(Fraction(a) * Fraction(b) for a, b in zip(weights, declared, strict=True))
    assert Fraction(fit.lower) <= needed
    assert 0.0 <= fit.lower <= fit.upper
    assert not fit.refuted
    scaled = least(problem.scaled(declared), np.ones(1))
    assert scaled.lower <= 1.0
    if np.isfinite(fit.upper):
        size = 1.0 + np.nanmax(np.abs(truth.record.y))
        missed, outside, moved, apart = replayed(name, truth, fit)
        assert missed <= 2e-9 * size and moved <= 1e-9 * size
        assert outside <= 0.0 and apart == 0.0
    return fit, scaled


@pytest.mark.parametrize("name", [name for name in PLANTS if name != "battery"])
def test_truths(name):
    hold(name, 0, 8)


@pytest.mark.long
@pytest.mark.parametrize("name", PLANTS)
@pytest.mark.parametrize("seed", range(1, 35))
def test_many_truths(name, seed):
    hold(name, seed)


@pytest.mark.long
def test_bounds_that_are_too_small_are_found_and_parameters_kept():
    """Of records that need more than .98 of their bounds, most refute .98 of them."""
    found = possible = intervals = 0
    for name in (name for name in PLANTS if name != "battery"):
        for seed in range(1, 7):
            truth = happened(name, seed, 24)
            problem, declared = asked(truth)
            scaled = least(problem.scaled(declared), np.ones(1))
            possible += scaled.upper > 0.98
            found += scaled.lower > 0.98
            if problem.still.any():
                left = narrowed(problem, declared)
                for j in np.flatnonzero(problem.still):
                    low, high = map(mp.mpf, left.box[j])
                    assert low <= truth.v[0][j] <= high
                    intervals += high - low < problem.box[j, 1] - problem.box[j, 0]
    assert possible >= 8 and found >= 0.8 * possible
    assert intervals >= 4
