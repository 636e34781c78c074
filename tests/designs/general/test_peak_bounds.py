"""Peak bounds of the general class against what the error system reaches, computed otherwise.

Mutants, each of which fails here: the channels of h or of F without their coupling; delta and
delta' taken as one; w counted once where it enters rows and outputs; e_q without L0 V; the rest of
the family left out; the correction's own share of the channels of h left out; K without the
channels of h, without V, without C0 or with the other sign; delta' of Z and of K taken as two.
"""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import sympy as sp

import obsynth as ob
from methods import motor
from obsynth.designs.core.errors import InfeasibleDesign
from obsynth.designs.general.fading import exponential, fade, prove_fading, recursion
from obsynth.designs.general.method import GeneralUIO, bound_peak
from obsynth.designs.general.model import read
from obsynth.designs.general.peak import error_sums, prove_peak, small_gain_solution
from obsynth.designs.general.record import Rounding
from obsynth.designs.general.system import error_system, extra_inputs

# of one state: Z and K
GAINS = [(0.2, 0.0), (0.45, 0.0), (0.8, 0.0), (0.0, 0.3), (0.0, 0.5), (0.3, 0.2)]


def scalar(sign=1, touched=0):
    """One state; the same w in row and output; both slopes vary, by w too if touched."""
    plant = ob.Plant("scalar")
    (x,) = plant.states("x", range=(-1, 1))
    (w,) = plant.disturbances("w", bound=0.1)
    bend = sp.sin(3 * x)
    plant.dynamics([sp.Rational(6, 10) * x + sign * bend / 30 + w * (1 + touched * x)], Ts=1)
    plant.outputs([x + bend / 20 + w * (1 + touched * x)])
    return plant


def exactly(Z, middle, reach, w=0.1, K=0.0):
    """The largest |e_q| and |e_c| of one state: corners of all signs, again and again.

    middle, reach: of [A W; C V] and its deviations, each with a sign of its own; both gains see
    the same innovation
    """
    (A, W), (C, V) = middle
    (a, b), (c, d) = reach
    signs = np.array(list(product((-1.0, 1.0), repeat=5))).T
    s = signs[0]
    p = most = 0.0
    for _ in range(600):
        nu = (C + c * signs[1]) * p + (V + d * signs[2]) * s * w
        e = p - Z * nu
        most = max(most, np.abs(e).max())
        p = np.abs((A + a * signs[3]) * e - K * nu + (W + b * signs[4]) * s * w).max()
    return p, most


def reach_of(family):
    half = 0.5 * np.diff(family.ranges, axis=1)[:, 0]
    return np.tensordot(half, np.abs(family.directions), axes=1)


def fixed(family):
    """The family's middle alone."""
    middle = family.ranges.mean(axis=1)[:, None]
    return replace(family, ranges=np.repeat(middle, 2, axis=1))


@pytest.mark.parametrize(("Z", "K"), [*GAINS, (0.8, -0.4), (0.9, -0.54)])
@pytest.mark.parametrize(("sign", "touched"), [(1, 0), (-1, 0), (1, 2), (-1, 2)])
def test_bounds_of_one_state_are_above_the_worst_and_near_it(Z, K, sign, touched):
    model = read(scalar(sign, touched))
    design = bound_peak(replace(model.design, Z=np.array([[Z]]), K=np.array([[K]])))
    worst = exactly(Z, design.middle, reach_of(design.family), K=K)
    assert np.all(design.bound.b >= worst)
    assert np.all(design.bound.b <= 1.25 * np.array(worst))


@pytest.mark.parametrize(("Z", "K"), [(0.45, 0.0), (0.0, 0.3), (0.3, 0.2)])
@pytest.mark.parametrize(("i", "j"), list(product(range(2), range(2))))
def test_what_the_family_leaves_open_entry_by_entry_counts(i, j, Z, K):
    design = replace(read(scalar()).design, Z=np.array([[Z]]), K=np.array([[K]]))
    radius = np.zeros((2, 2))
    radius[i, j] = 0.1
    family = replace(fixed(design.family), radius=radius)
    found = bound_peak(replace(design, family=family)).bound.b
    worst = np.array(exactly(Z, design.middle, radius, K=K))
    assert np.all(found >= worst)
    assert np.all(found <= 1.25 * worst)


def test_channels_reach_both_ends_of_every_range():
    """Mutant: radii of the half width, not of the larger distance from the rounded middle."""
    design = replace(read(motor()).design)
    family = design.family
    ends = family.ranges + np.array([[0.0, 0.25]]) * np.ones((len(family.ranges), 1))
    design = replace(design, family=replace(family, ranges=ends))
    system, N = error_system(design), design.size
    for channels, rows in ((system.of_F, slice(0, N)), (system.of_h, slice(N, None))):
        for column, radius, source in zip(
            channels.columns.T, channels.radii, channels.sources, strict=True
        ):
            (k,) = [
                k
                for k, direction in enumerate(family.directions)
                if np.array_equal(direction[rows, source], column)
            ]
            middle = sp.Rational(ends[k].mean())
            assert all(abs(sp.Rational(end) - middle) <= sp.Rational(radius) for end in ends[k])


def test_what_rounding_the_middle_moves_counts():
    """Against exact rationals. Mutant: the family's radius alone, which here is none."""
    design = read(motor()).design
    family = replace(design.family, radius=0.0 * design.family.radius)
    design = design.changed(family=family)
    exact = sp.Matrix(family.constant).applyfunc(sp.Rational)
    for (low, high), direction in zip(family.ranges.tolist(), family.directions, strict=True):
        step = sp.Matrix(direction).applyfunc(sp.Rational)
        exact += sp.Rational((low + high) / 2) * step
    apart = (exact - sp.Matrix(design.middle).applyfunc(sp.Rational)).applyfunc(abs)
    rest = error_system(design).rest
    assert any(apart) and all(
        sp.Rational(have) >= a for have, a in zip(rest.flat, apart, strict=True)
    )


def rotated(design, seed, kind):
    """The worst errors of a constant member of the family, the middle or one at random corners.

    By the equations of the observer and the plant at this member, not by the sums.
    """
    rng = np.random.default_rng(seed)
    N, family = design.size, design.family
    ends = family.ranges[np.arange(len(family.ranges)), rng.integers(0, 2, len(family.ranges))]
    other = family.ranges[np.arange(len(family.ranges)), rng.integers(0, 2, len(family.ranges))]
    F = family.at(ends if kind else family.ranges.mean(axis=1))[:N]
    h = family.at(other if kind else family.ranges.mean(axis=1))[N:]
    A, W, C, V = F[:, :N], F[:, N:], h[:, :N], h[:, N:]
    n_v = W.shape[1]
    eye = np.eye(N)
    T = eye - design.L0 @ design.middle[N:, :N]
    reached = np.zeros(2 * N)
    for j in range(n_v):
        e_p = np.zeros(N)
        total = np.zeros(2 * N)
        for k in range(400):
            v = np.zeros(n_v)
            v[j] = design.v_radius[j] if k == 0 else 0.0
            e_q = T @ e_p - design.L0 @ V @ v
            nu = C @ e_q + V @ v
            e_c = e_q - design.Z @ nu
            total += np.abs(np.concatenate([e_q, e_c]))
            e_p = A @ e_c + W @ v - design.K @ nu
        reached += total
    return reached


@pytest.fixture(scope="module")
def searched():
    model = GeneralUIO().read(motor())
    return GeneralUIO().solve(model)


@pytest.fixture(scope="module", params=[0.0, 0.5, 1.0], ids=["Z", "Z and K", "K"])
def designed(searched, request):
    """So much of the gain given to the prediction, as is done at once or a step later."""
    N = searched.size
    K = request.param * searched.middle[:N, :N] @ searched.Z
    return bound_peak(searched.changed(Z=(1.0 - request.param) * searched.Z, K=K))


def test_no_constant_member_of_the_family_goes_beyond_the_bounds(designed):
    worst = np.max([rotated(designed, seed, seed > 0) for seed in range(12)], axis=0)
    assert np.all(worst <= designed.bound.b * (1 + 1e-12))
    # and the middle alone is not far below
    assert np.all(
        rotated(designed, 0, 0)[designed.size :] >= 0.5 * designed.bound.b[designed.size :]
    )


def test_of_one_member_the_bounds_are_attained(designed):
    """Mutants: any part of what v moves left out, or with another sign."""
    alone = bound_peak(designed.changed(family=fixed(designed.family)))
    assert alone.bound.b == pytest.approx(rotated(alone, 0, 0), rel=1e-6)


@pytest.mark.parametrize(("Z", "K"), [(0.45, 0.0), (0.0, 0.3), (0.3, 0.2), (0.8, -0.2)])
@pytest.mark.parametrize("stage", ["q", "c", "p"])
def test_rounding_of_every_stage_enters_the_bounds(stage, Z, K):
    """An error of delta in a stage, at every call with the worst sign, is one more input."""
    delta = 1e-3
    design = replace(read(scalar()).design, Z=np.array([[Z]]), K=np.array([[K]]))
    design = replace(design, family=fixed(design.family))
    zero = np.zeros(1)
    parts = {"q": zero, "c": zero, "p": zero, stage: np.array([delta])}
    plain, more = bound_peak(design), bound_peak(replace(design, rounding=Rounding(**parts)))
    (A0, _), (C0, _) = design.middle
    keep = 1 - Z * C0
    decay = 1 - abs(A0 * keep - K * C0)
    once = {"q": delta, "c": 0.0, "p": 0.0}[stage]
    into = {"q": abs(A0 * keep - K * C0), "c": abs(A0), "p": 1.0}[stage] * delta / decay
    q = once + into
    c = abs(keep) * q + (delta if stage == "c" else 0.0)
    added = more.bound.b - plain.bound.b
    assert added == pytest.approx([q, c], rel=1e-6)


def test_a_smaller_b_is_not_proved(designed):
    system = error_system(designed)
    sums = error_sums(system, extra_inputs(system, designed))
    names = designed.extended.plant.names("x")
    assert all(claim.holds for claim in prove_peak(sums, designed.bound.b, names))
    assert sums.powers.contraction < 0.5
    for k in range(2 * designed.size):
        b = designed.bound.b.copy()
        b[k] *= 1.0 - 1e-6
        peak, _ = prove_peak(sums, b, names)
        assert not peak.holds and peak.margin < 0.0
        assert peak.proof.endswith(f"too small for {names[k % designed.size]}")


def test_gains_that_leave_the_errors_unstable_or_unbounded_are_refused():
    design = read(scalar()).design
    with pytest.raises(InfeasibleDesign, match="not stable"):
        bound_peak(replace(design, Z=np.array([[4.0]])))
    middle = design.family.ranges.mean(axis=1, keepdims=True)
    wide = replace(design.family, ranges=middle + 12.0 * (design.family.ranges - middle))
    with pytest.raises(InfeasibleDesign, match="small-gain"):
        bound_peak(replace(design, family=wide, Z=np.array([[0.01]])))


def free_errors(design, start, steps, rng):
    """|e_c| of the error recursion from a first error, with members at random corners."""
    N, family = design.size, design.family
    e_p = start.copy()
    T = np.eye(N) - design.L0 @ design.middle[N:, :N]
    found = []
    rows = np.arange(len(family.ranges))
    for _ in range(steps):
        F = family.at(family.ranges[rows, rng.integers(0, 2, len(rows))])[:N, :N]
        h = family.at(family.ranges[rows, rng.integers(0, 2, len(rows))])[N:, :N]
        e_q = T @ e_p
        e_c = e_q - design.Z @ (h @ e_q)
        found.append(np.abs(e_c))
        e_p = F @ e_c - design.K @ (h @ e_q)
    return np.array(found)


@pytest.mark.parametrize("apart", ["channels", "entries"])
@pytest.mark.parametrize(("Z", "K"), GAINS)
def test_a_first_error_of_one_state_fades_no_slower_than_the_worst_members(Z, K, apart):
    """Mutants: the channels or the rest of h or F left out of G or of reach."""
    design = replace(read(scalar()).design, Z=np.array([[Z]]), K=np.array([[K]]))
    reach = reach_of(design.family)
    if apart == "entries":
        design = replace(design, family=replace(fixed(design.family), radius=reach))
    design = bound_peak(design)
    system = error_system(design)
    (A, _), (C, _) = design.middle
    (a, _), (c, _) = reach
    slopes = [C + s * c for s in (-1, 1)]
    keep = max(abs(1 - Z * slope) for slope in slopes)
    step = max(abs((A + s * a) * (1 - Z * h) - K * h) for s in (-1, 1) for h in slopes)
    fading = design.bound.fading
    ways = [(fading.G, fading.reach, fading.start, 1.02), (*exponential(system, 0.8), 4.0)]
    for G, reach, start, loss in ways:
        s = start @ np.ones(1)
        for k in range(8):
            worst = keep * step**k
            assert worst <= (reach @ s)[0]
            assert k > 0 or (reach @ s)[0] <= loss * worst
            s = G @ s


@pytest.mark.parametrize("form", ["modes", "exponential"])
def test_a_first_error_fades_no_slower_than_is_said(designed, form):
    """Mutants: start, reach or G smaller by 1 %; the channels left out of G or of reach."""
    system = error_system(designed)
    if form == "modes":
        fading = fade(system, designed.bound.b, np.ones(designed.size))
        assert fading.modes is not None
        G, reach, start = fading.G, fading.reach, fading.start
    else:
        G, reach, start = exponential(system, 0.99)
    rng = np.random.default_rng(0)
    N = designed.size
    for j in range(3 * N):
        first = np.eye(N)[j] if j < N else rng.standard_normal(N)
        errors = free_errors(designed, first, 120, rng)
        s = start @ np.abs(first)
        for k, error in enumerate(errors):
            assert np.all(error <= reach @ s * (1 + 1e-9) + 1e-15), (j, k)
            s = G @ s


@pytest.mark.parametrize(("Z", "K"), [(0.45, 0.0), (0.0, 0.3), (0.3, 0.2)])
def test_an_exponential_counts_the_step_by_which_an_input_is_late(Z, K):
    """Scalars: sums of (M A0 / decay)^k, an input one step later. Mutant: not divided by decay."""
    decay = 0.6
    design = replace(read(scalar()).design, Z=np.array([[Z]]), K=np.array([[K]]))
    design = bound_peak(replace(design, family=replace(fixed(design.family))))
    radius = np.array([[0.1, 0.0], [0.0, 0.0]])
    design = replace(design, family=replace(design.family, radius=radius))
    (A, _), (C, _) = design.middle
    keep = abs(1 - Z * C)
    gain = 0.1 * keep / decay / (1 - abs(A * (1 - Z * C) - K * C) / decay)
    start = exponential(error_system(design), decay)[2]
    assert start[0, 0] == pytest.approx(keep / (1 - gain), rel=1e-6)


@pytest.mark.parametrize(("Z", "K"), [(0.45, 0.0), (0.0, 0.3), (0.3, 0.2)])
def test_an_exponential_counts_what_readings_leave_open(Z, K):
    """Scalars again, the slope of the reading open. Mutants: it moves e_c or e_p alone."""
    decay, rho = 0.6, 0.1
    design = replace(read(scalar()).design, Z=np.array([[Z]]), K=np.array([[K]]))
    radius = np.array([[0.0, 0.0], [rho, 0.0]])
    design = bound_peak(replace(design, family=replace(fixed(design.family), radius=radius)))
    (A, _), (C, _) = design.middle
    back, keep = A * Z + K, 1 - Z * C
    late = 1 / (decay - abs(A - back * C))
    q = 1 / (1 - late * back * rho)
    start = exponential(error_system(design), decay)[2]
    assert start[0, 0] == pytest.approx(keep + rho * (keep * late * back + Z) * q, rel=1e-6)


def test_fading_with_less_is_not_proved(designed):
    system, fading = error_system(designed), designed.bound.fading
    assert all(claim.holds for claim in prove_fading(system, fading))
    for part in ("G", "reach", "start"):
        smaller = replace(fading, **{part: getattr(fading, part) * (1.0 - 1e-3)})
        failed = [claim.name for claim in prove_fading(system, smaller) if not claim.holds]
        assert failed == ["transient"]
    assert recursion(system, replace(fading.modes, inverse=2.0 * fading.modes.inverse)) is None


def test_a_small_gain_solution_is_above_the_exact_one():
    rng = np.random.default_rng(3)
    for _ in range(50):
        G = rng.random((6, 6)) * (rng.random((6, 6)) < 0.5)
        G *= 0.9 / max(np.abs(np.linalg.eigvals(G)).max(), 1e-9)
        n = rng.random(6)
        b = small_gain_solution(G, n)
        exact = (
            sp.Matrix(np.eye(6) - G)
            .applyfunc(sp.Rational)
            .LUsolve(sp.Matrix([sp.Rational(v) for v in n]))
        )
        assert all(sp.Rational(have) >= want for have, want in zip(b.tolist(), exact, strict=True))
