"""Random plants and exact truths: what is designed encloses, with and without room for rounding."""

from fractions import Fraction

import numpy as np
import pytest
import sympy as sp
from hypothesis import given, settings
from hypothesis import strategies as st

import obsynth as ob

R = sp.Rational
SHRINK = 1.0 - 1e-12


def random_plant(rng):
    """Up to four states, up to as many outputs, faults and unknown inputs, two parameters."""
    n = int(rng.integers(1, 5))
    m = int(rng.integers(1, n + 1))
    q = int(rng.integers(0, m + 1))
    n_f, n_rho, n_u = (int(rng.integers(0, top)) for top in (q + 1, 3, 3))

    def matrix(rows, columns, scale, share):
        def entry(i, j):
            number = R(int(rng.integers(-6, 7)), int(rng.integers(3, 12)))
            return number * scale if rng.uniform() < share else 0

        return sp.Matrix(rows, columns, entry)

    def ends(low, high):
        return (R(int(rng.integers(-9, 1)), low), R(int(rng.integers(0, 9)), high))

    p = ob.Plant("random")
    x = p.states(f"x1:{n + 1}", range=(-5, 5))
    u = p.inputs(f"u1:{n_u + 1}", range=(-1, 1)) if n_u else ()
    ranges = [ends(8, 8) for _ in range(n_rho)]
    rho = p.scheduling(f"rho1:{n_rho + 1}", range=ranges, measured=False) if n_rho else ()
    d = p.unknown_inputs(f"d1:{q - n_f + 1}") if q > n_f else ()
    f = p.faults(f"f1:{n_f + 1}") if n_f else ()
    w = p.disturbances(f"w1:{n + 1}", range=[ends(300, 500) for _ in range(n)])
    v = p.disturbances(f"v1:{m + 1}", range=[ends(300, 500) for _ in range(m)])
    A, moved = matrix(n, n, R(2, 5), 0.7), matrix(n, n, 1, 0.7) * sp.Matrix(w)
    for parameter in rho:
        A += parameter * matrix(n, n, R(1, 10), 0.3)
    moved += A * sp.Matrix(x)
    if n_u:
        B = matrix(n, n_u, 1, 0.7)
        for parameter in rho:
            B += parameter * matrix(n, n_u, R(1, 5), 0.3)
        moved += B * sp.Matrix(u)
    if q:
        moved += matrix(n, q, 1, 0.9) * sp.Matrix([*f, *d])
    p.dynamics(moved, Ts=1)
    y = matrix(m, n, 1, 0.8) * sp.Matrix(x) + matrix(m, m, 1, 0.5) * sp.Matrix(v)
    p.outputs(y + matrix(m, n, R(3, 10), 0.2) * sp.Matrix(w))
    return p


def drawn(rng, box, shape, kind):
    middle, half = box.mean(axis=1), 0.5 * (box[:, 1] - box[:, 0]) * SHRINK
    size = (*shape, len(box))
    if kind == "uniform":
        return middle + half * rng.uniform(-1.0, 1.0, size)
    if kind == "corner":
        return middle + half * np.broadcast_to(rng.choice([-1.0, 1.0], (shape[1], len(box))), size)
    return middle + half * rng.choice([-1.0, 1.0], size)


def check(seed, run_many, options):
    """Design for a random plant; None where it is refused, else whether all is enclosed."""
    rng = np.random.default_rng(seed)
    plant = random_plant(rng)
    try:
        # nothing begins anew in a run: faults of 3 may take the states out of their ranges
        observer = ob.IntervalObserver(horizon=100, **options).design(plant)
    except (ob.StructureError, ob.InfeasibleDesign):
        return None
    assert observer.certificate.valid
    many, steps = 40, 30
    shape, box = (steps + 1, many), np.tile([-1.0, 1.0], (len(plant.x), 1))
    fine = True
    for kind in ("uniform", "bang-bang", "corner"):
        u = rng.uniform(-1.0, 1.0, (steps + 1, len(plant.u), many))
        run = run_many(
            observer,
            drawn(rng, box, (1, many), kind)[0],
            drawn(rng, plant.box("w"), shape, kind),
            rng.uniform(-3.0, 3.0, (*shape, len(plant.f))),
            drawn(rng, plant.box("rho"), shape, kind),
            lambda k, y, u=u: u[k],
            x_range=box,
            d=rng.uniform(-3.0, 3.0, (*shape, len(plant.d))),
        )
        fine &= bool(run.x_inside().all() and run.f_inside().all())
        fine &= not (run.status[1:].astype(int) & 8).any()
        if np.abs(run.x).max() < 5.0:
            widths = 0.5 * (run.x_upper - run.x_lower)[-5:].max(axis=(0, 1))
            # the observer's own; those of the cut sets take more calls than these to settle
            own = observer.performance["core_half_widths"][: len(plant.x)]
            fine &= bool(np.all(widths <= own * 1.01 + 1e-6))
    return fine


@pytest.mark.long
@settings(max_examples=6, derandomize=True, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_whatever_is_designed_encloses(run_many, seed):
    assert check(seed, run_many, {}) in (None, True)


@pytest.mark.long
@pytest.mark.parametrize("contraction", [True, False])
def test_whatever_is_designed_encloses_for_many_plants(contraction, run_many):
    results = [check(seed, run_many, {"contraction": contraction}) for seed in range(16)]
    assert False not in results
    assert results.count(True) >= 10


# -- truths in exact arithmetic, noise to the very ends of its box --------------------------------


def exact_numbers(matrix, values):
    substituted = sp.Matrix(matrix).subs(values)
    return [Fraction(int(e.p), int(e.q)) for e in substituted]


def rational(signals, values):
    """The values by the symbols of the signals, as SymPy numbers."""
    return {
        s.symbol: sp.Rational(*v.as_integer_ratio()) for s, v in zip(signals, values, strict=True)
    }


def exact_run(observer, rng, steps, law):
    """Return how often the exact state and fault are inside, at tolerance 0."""
    plant = observer.model
    box = [(s.lower, s.upper) for s in plant.w]
    x = [Fraction(float(s)) for s in rng.choice([-1.0, 1.0], len(plant.x))]
    memory = observer.memory0(np.zeros(len(x)), x_range=np.tile([-1.0, 1.0], (len(x), 1)))
    inside, total, last = 0, 0, None
    for _ in range(steps):
        sides = rng.integers(0, 2, len(box))
        ends = [Fraction(float(pair[int(s)])) for pair, s in zip(box, sides, strict=True)]
        f = Fraction(float(rng.uniform(-1.0, 1.0)))
        rho = [Fraction(int(s)) for s in rng.choice([-1, 1], len(plant.rho))]
        signals = (*plant.x, *plant.w, *plant.rho, plant.f[0])
        values = rational(signals, [*x, *ends, *rho, f])
        y = []
        for i, exact_y in enumerate(exact_numbers(plant.output, values)):
            # the number that is measured is a double; v takes up the difference, inside its box
            noise = len(box) - len(plant.output) + i
            clean = exact_y - ends[noise]
            measured = float(exact_y)
            low, high = (Fraction(end) for end in box[noise])
            while Fraction(measured) - clean > high:
                measured = np.nextafter(measured, -np.inf)
            while Fraction(measured) - clean < low:
                measured = np.nextafter(measured, np.inf)
            y.append(float(measured))
        u = np.array(law(y), dtype=float)
        values |= {
            s.symbol: sp.Rational(*float(v).as_integer_ratio())
            for s, v in zip(plant.u, u, strict=True)
        }
        out = [np.array(o).ravel() for o in observer.step(memory, u, y)]
        memory = out[0]
        for value, low, high in zip(x, out[3], out[4], strict=True):
            inside += Fraction(low) <= value <= Fraction(high)
            total += 1
        if last is not None:
            inside += Fraction(out[5][0]) <= last <= Fraction(out[6][0])
            total += 1
        last = f
        x = exact_numbers(plant.rhs, values)
    return inside, total


@pytest.mark.parametrize("seed", range(3))
def test_exact_truth_at_the_ends_of_the_noise(seed, example, tight_plant):
    for plant, law in (
        (example, lambda y: [1.5 * y[0] + 2.0 * y[1]]),
        (tight_plant, lambda y: []),
    ):
        observer = ob.IntervalObserver().design(plant)
        inside, total = exact_run(observer, np.random.default_rng(seed), 25, law)
        assert inside == total
