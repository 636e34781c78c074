"""The allowance for rounding is proved: tanks against a table, plants against rationals."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
import sympy as sp
from tapes import NUMPY, tape

import obsynth as ob
from methods import PEAK_GAINS
from obsynth.designs.bounded_error.claims import claims, covers, guarantee
from obsynth.designs.bounded_error.model import rounding_allowance
from obsynth.designs.bounded_error.rounding import of_matrices, of_step, settle
from obsynth.designs.bounded_error.step import equations
from obsynth.designs.core.boxes import cut_box
from obsynth.designs.core.rounding import rounding_bound
from obsynth.designs.core.signals import Limits


def designed(plant, **options):
    """A design and what was read of its plant."""
    method = ob.BoundedErrorUIO(**options)
    model = method.read(plant)
    return method.solve(model), model


@pytest.fixture(scope="module")
def tanks(tank, base):
    """Given gains; the bound, which is that of others, does not matter here."""
    model = ob.BoundedErrorUIO().read(tank)
    given = replace(model.design, **PEAK_GAINS, bound=base.certificate.design.bound)
    return settle(given, model.split.proof.rounding)


def narrow(design, spread=1.0, faults=5.0, correction=0.2):
    """Cells of estimates in their ranges, readings within `spread` of them, small faults."""
    lo, hi = cut_box(design.plant.box("x"), 4 ** len(design.plant.x))
    kept = np.abs(design.E).sum(axis=1) == 0.0
    z = [np.where(kept[:, None], end, side * correction) for end, side in ((lo, -1), (hi, 1))]
    f = np.full((2, 1), faults)
    u = design.plant.box("u")
    box = {
        "z": tuple(z),
        "fhat": (-f, f),
        "u": (u[:, :1], u[:, 1:]),
        "y": (lo[:3] - spread, hi[:3] + spread),
    }
    nu = np.full((3, 1), spread)
    return box, {"xhat": (lo, hi), "innovation": (-nu, nu)}


def test_four_tanks_have_the_bounds_of_the_table(tanks):
    """Between half of what an independent analysis found and it, and close to what is seen.

    That analysis takes u |value| for a rounding; half the distance of numbers at it is up to half.

    Mutants: Sterbenz left out (fhat a hundred times), known outputs left out.
    """
    box, known = narrow(tanks)
    single = rounding_bound(equations(tanks), box, "single", known)
    table = np.array([6.77e-5, 6.73e-5, 1.82e-5])
    found = single["z_next"].error[[0, 1, 3]]
    assert np.all((table / 2 < found) & (found < table))
    np.testing.assert_allclose(found, [6.17e-5, 6.14e-5, 1.16e-5], rtol=1e-3)
    double = rounding_bound(equations(tanks), box, "double", known)
    assert double["z_next"].error.max() < 1.29e-13
    rng = np.random.default_rng(0)
    count = 100_000
    x = rng.uniform(*tanks.plant.box("x").T[:, :, None], (4, count))
    corner = rng.random(x.shape) < 0.15
    ends = tanks.plant.box("x")
    x = np.where(corner, np.where(rng.random(x.shape) < 0.5, ends[:, :1], ends[:, 1:]), x)
    z = np.where(np.abs(tanks.E).sum(axis=1)[:, None] == 0, x, rng.uniform(-0.2, 0.2, x.shape))
    points = [
        z,
        rng.uniform(-5, 5, (2, count)),
        rng.uniform(*tanks.plant.box("u").T[:, :, None], (2, count)),
        x[:3] + rng.uniform(-1, 1, (3, count)),
    ]
    points = [part.astype(np.float32) for part in points]
    found = tape(equations(tanks), points, NUMPY, lambda v: np.full(count, v, np.float32))
    exact = tape(
        equations(tanks),
        [part.astype(float) for part in points],
        NUMPY,
        lambda v: np.full(count, v),
    )
    seen = np.array([np.abs(a - b).max() for a, b in zip(found, exact, strict=True)])
    limits = np.concatenate([part.error for part in single.values()])
    assert np.all(seen <= limits)
    z_next = slice(4 + 3 + 4, 4 + 3 + 8)
    assert np.all(limits[z_next][[0, 1, 3]] < np.array([1.2, 1.2, 1.2]) * seen[z_next][[0, 1, 3]])


def test_the_allowance_of_the_tanks_is_proved_and_small(tanks):
    assert np.all(of_step(tanks) <= tanks.rounding)
    assert tanks.rounding.max() < 2.0**-40 * 280
    said = " ".join(guarantee(tanks).assumptions)
    assert "f1 in [-1e+06, 1e+06]" in said
    assert "which is proved for IEEE doubles" in said


def test_a_smaller_allowance_falls(tanks):
    """Mutant: a claim that compares with nothing."""
    spoilt = replace(tanks, rounding=tanks.rounding * 0.9)
    assert not {claim.name: claim.holds for claim in claims(spoilt)}["rounding"]


def random_plant(seed, ranged=False, shift=0.0, large=2.0):
    """A linear plant whose coefficients are no doubles; an unknown input; noise off its middle."""
    rng = np.random.default_rng(seed)
    plant = ob.Plant(f"random {seed}")
    n = int(rng.integers(2, 4))
    x = plant.states(" ".join(f"x{i}" for i in range(n)), range=(-5, 5))
    (u,) = plant.inputs("u", range=(-3, 3))
    (d,) = plant.unknown_inputs("d", range=(-large, large))
    (f,) = plant.faults("f", rate=0.01, **({"range": (-3, 4)} if ranged else {}))
    w = plant.disturbances(" ".join(f"w{i}" for i in range(n)), range=(shift - 0.1, shift + 0.1))

    def third(top=9):
        return sp.Rational(int(rng.integers(1, top)), int(rng.choice([3, 7, 11, 13, 30])))

    rows = [third(4) * x[i] / 3 + third() * x[(i + 1) % n] / 30 for i in range(n)]
    rows = [row + third() * u for row in rows]
    rows[0] += third() * f
    rows[1] += third() * d
    plant.dynamics([row + third() * w[0] / 9 for row in rows], Ts=1)
    plant.outputs([third() * x[i] + x[0] / 7 + third() * w[i] / 9 for i in range(n)])
    return plant


def exact(matrix):
    return np.array([[Fraction(float(v)) for v in row] for row in np.atleast_2d(matrix)])


def true_matrices(plant):
    """Coefficients of the plant's own equations, in rationals."""
    groups = (plant.x, plant.f, plant.d, plant.w, plant.u)

    def of(rows, signals):
        found = [
            [sp.diff(row, s.symbol).subs(plant.constant_values) for s in signals] for row in rows
        ]
        return np.array([[Fraction(int(v.p), int(v.q)) for v in row] for row in found])

    return [of(plant.rhs, g) for g in groups], [of(plant.output, g) for g in (plant.x, plant.w)]


@pytest.mark.parametrize("seed", range(6))
def test_plants_with_coefficients_that_are_no_doubles_are_designed_and_covered(seed):
    """One step in doubles of the true plant against the stored recursion, in rationals.

    What it is off by is rounding of the step, of B_f, C, W1, W2, D, and what is left of d. Mutants:
    an allowance without the matrices (refused after the design), or without one of their terms.
    """
    large = 1e9 if seed == 5 else 2.0
    plant = random_plant(seed, ranged=seed % 2 == 1, shift=0.3 * (seed % 3), large=large)
    design, model = designed(plant)
    assert all(claim.holds for claim in [*claims(design), *covers(design, model)])
    (A, B_f, D, W1, B), (C, W2) = true_matrices(plant)
    rng = np.random.default_rng(seed)
    limits, inner = Limits.of(plant), equations(design)
    stored = {k: exact(getattr(design, k)) for k in ("E", "K", "F", "C", "W1", "W2", "B_f")}
    stored["T"] = np.eye(len(A), dtype=int) + stored["E"] @ stored["C"]
    centre = exact(design.w_centre)[0]
    worst = np.zeros(len(A) + 1)
    for _ in range(40):
        side = rng.choice([-1.0, 1.0, 0.3], len(A))
        x = exact(side * 5.0)[0]
        f = exact(rng.choice(limits.f[0]))[0]
        fhat = rng.choice(limits.f[0], 1)
        d, u = exact(rng.choice([-large, large]))[0], rng.uniform(-3, 3, 1)
        w = centre + exact(rng.choice([-0.1, 0.1], len(A)))[0]
        y = np.array([float(v) for v in C @ x + W2 @ w])
        # the noise that makes the readings doubles
        w = w + exact_solution(W2, exact(y)[0] - (C @ x + W2 @ w))
        shifted = y - design.W2 @ design.w_centre
        guess = rng.uniform(-5, 5, len(A))
        z = guess + design.E @ shifted
        xhat, _, _, z_next, fhat_next = (np.array(v).ravel() for v in inner(z, fhat, u, shifted))
        if np.any(np.abs(xhat) > 5.0):
            continue
        zeta = stored["T"] @ x - exact(z)[0]
        e = zeta + stored["E"] @ stored["W2"] @ (w - centre)
        e_f = f - exact(fhat)[0]
        nu = stored["C"] @ e + stored["W2"] @ (w - centre)
        kept = stored["T"] @ (A @ e + stored["B_f"] @ e_f + stored["W1"] @ (w - centre))
        x_next = A @ x + B_f @ f + D @ d + W1 @ w + B @ exact(u)[0]
        off = stored["T"] @ x_next - exact(z_next)[0] - (kept - stored["K"] @ nu)
        off_f = (f - exact(fhat_next)[0]) - (e_f - stored["F"] @ nu)
        worst = np.maximum(worst, [float(abs(v)) for v in (*off, *off_f)])
        outside = np.abs([float(v) for v in x - exact(xhat)[0] - e])
        assert np.all(outside <= design.rounding[:-1])
    assert np.all(worst <= design.rounding)
    assert design.rounding.max() < 1e3 * worst.max()


@pytest.mark.parametrize("letter", ["D", "B_f", "W1", "C", "W2"])
def test_every_matrix_that_is_rounded_counts(letter):
    """Matrices off by a hundredth, so that nothing else matters: near the bound, never above.

    Mutants: a term of `of_matrices` dropped or halved, the way through E, K or F left out.
    """
    rng = np.random.default_rng(1)
    plant = random_plant(1, ranged=True, shift=0.3)
    design, _ = designed(plant, gamma=0.05)
    design = replace(design, K=design.K + 0.3, F=design.F - 0.2, E=design.E + 0.1)
    design = replace(design, T=np.eye(len(design.A)) + design.E @ design.C)
    names = ("D", "B_f", "W1", "C", "W2")
    off = {name: np.zeros_like(getattr(design, name)) for name in names}
    off[letter] = np.full_like(getattr(design, letter), 0.01)
    limits, centre = Limits.of(plant), design.w_centre
    count, E, T, K, F = 4000, design.E, design.T, design.K, design.F
    x = rng.choice(limits.x[0], (len(T), count))
    f, fhat = (rng.choice(limits.f[0], (1, count)) for _ in range(2))
    d, w = rng.choice([-2, 2], (1, count)), rng.choice([0.2, 0.4], (len(centre), count))
    worst = np.zeros(len(T) + 1)
    for _ in range(20):
        true = {k: getattr(design, k) + rng.choice([-1, 1], off[k].shape) * off[k] for k in names}
        spread = w - centre[:, None]
        y = true["C"] @ x + true["W2"] @ w - design.W2 @ centre[:, None]
        z = T @ x - rng.normal(size=x.shape)
        xhat = z - E @ y
        nu = y - design.C @ xhat
        z_next = T @ (design.A @ xhat + true["B_f"] @ fhat + true["W1"] @ centre[:, None]) + K @ nu
        x_next = design.A @ x + true["B_f"] @ f + true["W1"] @ w + (true["D"] - design.D) @ d
        e = T @ x - z + E @ design.W2 @ spread
        seen = design.C @ e + design.W2 @ spread
        kept = T @ (design.A @ e + design.B_f @ (f - fhat) + design.W1 @ spread) - K @ seen
        off_x = np.maximum(np.abs(T @ x_next - z_next - kept), np.abs(x - xhat - e))
        off_f = np.abs(F @ (nu - seen))
        worst = np.maximum(worst, np.concatenate([off_x, off_f]).max(axis=1))
    limit = of_matrices(design, off)
    assert np.all(worst <= limit + 1e-12)
    assert np.all(limit <= 2.0 * worst + 1e-12)


def exact_solution(matrix, right):
    """Solve a square system of rationals."""
    table = sp.Matrix(matrix.shape[0], matrix.shape[1], lambda i, j: rational(matrix[i, j]))
    found = table.LUsolve(sp.Matrix([rational(v) for v in right]))
    return np.array([Fraction(int(v.p), int(v.q)) for v in found])


def rational(value):
    return sp.Rational(value.numerator, value.denominator)


def test_a_plant_that_no_bound_is_found_for_keeps_its_assumption():
    """A kink that a comparison makes: designed as before, and the guarantee says it assumes."""
    plant = ob.Plant("kink")
    x, z = plant.states("x z", range=(-5, 5))
    plant.disturbances("w", bound=0.1)
    kink = sp.Piecewise((x / 4, x + z / 3 > 0), (x / 4 + (x + z / 3) / 50, True))
    plant.dynamics([kink, z / 3 + x / 7], Ts=1)
    plant.outputs([x, z])
    design, model = designed(plant, gamma=0.05)
    named = {claim.name: claim for claim in [*claims(design), *covers(design, model)]}
    assert all(claim.holds for claim in named.values())
    assert "assumed" in named["rounding"].statement
    assert "not proved" in guarantee(design).assumptions[-1]


def test_kinks_in_one_state_are_proved():
    """Mutant: comparisons that are not taken apart."""
    plant = ob.Plant("kinks")
    x, z = plant.states("x z", range=(-5, 5))
    plant.disturbances("w", bound=0.1)
    kink = sp.Piecewise((x / 4, x > 1), (x / 3 - sp.Rational(1, 12), True))
    plant.dynamics([kink, z / 3 + x / 7 + sp.Abs(z) / 50 + sp.sign(x) * x / 90], Ts=1)
    plant.outputs([x, z])
    design, _ = designed(plant, gamma=0.05)
    named = {claim.name: claim for claim in claims(design)}
    assert named["rounding"].holds
    assert "assumed" not in named["rounding"].statement
    assert design.rounding.max() < 1e-13


def test_the_step_runs_the_equations_that_are_proved(base):
    """Bit for bit. Mutant: a step that forms T f + K nu in another order."""
    tanks = base.certificate.design
    step, layout = build(tanks)
    rng = np.random.default_rng(3)
    for _ in range(20):
        x = rng.uniform(*tanks.plant.box("x").T)
        y = x[:3] + rng.normal(size=3) * 0.01
        z, fhat = x + tanks.E @ y, rng.normal(size=2)
        memory = np.zeros(step.numel_in(0))
        parts = {"z": z, "fhat": fhat, "initialised": 1.0, "prediction": x}
        boxes = {"x_lower": x - 1, "x_upper": x + 1, "f_lower": fhat - 1, "f_upper": fhat + 1}
        for name, value in (parts | boxes).items():
            memory[layout[name]] = value
            if name + "_2" in layout:
                memory[layout[name + "_2"]] = value
        u = rng.uniform(0, 20, 2)
        after = np.array(step(memory, u, y)[0]).ravel()
        _, _, _, z_next, fhat_next = (np.array(v).ravel() for v in equations(tanks)(z, fhat, u, y))
        np.testing.assert_array_equal(after[layout["z"]], z_next)
        np.testing.assert_array_equal(after[layout["fhat"]], fhat_next)


def build(design):
    """The step of a design and the parts of its memory."""
    contract = ob.BoundedErrorUIO.CONTRACT
    observer = contract.certify(design, "lmi").observer()
    return observer.step, observer.memory_layout


def test_a_transformation_that_is_not_of_the_stored_matrices_counts(tanks):
    """By its distance from I + E C times the next state. Mutant: taken off instead."""
    T = tanks.T.copy()
    T[0, 0] += 1e-6
    state = np.abs(tanks.plant.box("x")[0]).max()
    before, after = of_step(tanks), of_step(replace(tanks, T=T))
    assert (after >= 0.0).all()
    assert before[0] < 1e-10 < 1e-7 * state < after[0] < 1.0


def test_what_is_assumed_where_nothing_is_proved_is_of_the_largest_state():
    """2^-40 of it, or of 1, and the unknown input's share. Mutants: the smaller; half of it."""
    plant = ob.plants.quadruple_tank().discretise("euler", Ts=1.0)
    largest = np.abs(plant.box("x")).max()
    assert largest > 1.0
    assert rounding_allowance(plant).tolist() == [2.0**-40 * largest] * 6
    assert (rounding_allowance(plant, 1e-3) >= 2.0**-40 * largest).all()
    small = ob.Plant("small")
    (x,) = small.states("x", range=(-0.1, 0.2))
    (d,) = small.unknown_inputs("d", range=(-3, 2))
    small.dynamics([x / 2 + d], Ts=1)
    small.outputs([x])
    assert rounding_allowance(small).tolist() == [2.0**-40]
    assert rounding_allowance(small, 1e-3)[0] >= 2.0**-40 + 3e-3
