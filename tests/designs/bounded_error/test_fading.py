"""What the first error adds to the peak bounds: soundness against adversaries, proof, speed."""

import json
import time
from dataclasses import replace
from fractions import Fraction

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import obsynth as ob
from obsynth.derive.rigour import Enclosure, ExactMatrix
from obsynth.designs.bounded_error.peak.bound import PeakBound, channel_inputs, peak_bound
from obsynth.designs.bounded_error.peak.design import stored_bound
from obsynth.designs.bounded_error.peak.fading import fade, prove_fading, recursion
from obsynth.designs.bounded_error.peak.system import peak_system
from obsynth.designs.bounded_error.peak.transient import transient
from obsynth.designs.bounded_error.step import first_bound, running_bound
from obsynth.designs.core.boxes import Ends
from obsynth.designs.general.modal import block_norms, contracts, enclosed_inverse, single
from obsynth.designs.general.record import Fading, Modes

# -- how long, how soon ------------------------------------------------------------------------


def test_tanks_settle_as_soon_as_their_slowest_mode(peak, tank):
    """Samples until every half width stays within 1.1 b, from the declared boxes, |f| <= 10.

    One exponential for all, as it was: 3800, for f1 3366.
    """
    design, b = peak.certificate.design, peak.performance["core_half_widths"]
    memory = peak.memory0(tank.box("x").mean(axis=1))
    kept = {part: ca.SX(memory[peak.memory_layout[part]]) for part in ("z", "fhat")}
    faults = Ends.of(np.array([(-10.0, 10.0)] * 2))
    s = np.array(ca.evalf(first_bound(design, Ends.of(tank.box("x")), faults, kept))).ravel()
    bound = running_bound(design)
    widths = []
    for _ in range(4000):
        widths.append(bound.half_widths(s))
        s = bound.decay @ s + bound.offset
    outside = np.array(widths) > 1.1 * b
    settled = [int(np.flatnonzero(column)[-1]) + 1 if column.any() else 0 for column in outside.T]
    assert max(settled) == pytest.approx(2045, rel=0.02)
    assert settled[4] <= 64
    assert int(np.flatnonzero(np.sum(widths, axis=1) > 1.1 * b.sum())[-1]) + 1 <= 1.02 * 1828


def test_a_start_costs_microseconds(peak, tank):
    guess = tank.box("x").mean(axis=1)
    times = []
    for _ in range(20):
        begin = time.perf_counter()
        peak.memory0(guess)
        times.append(time.perf_counter() - begin)
    assert min(times) < 1e-3


# -- adversaries -------------------------------------------------------------------------------


def bare(A, directions, ranges) -> PeakBound:
    """Errors that nothing is done about: their dynamics are those of the plant."""
    n = len(A)
    system = peak_system(
        A=A,
        B_f=np.zeros((n, 0)),
        C=np.eye(n)[:1],
        D=np.zeros((n, 0)),
        W1=np.eye(n),
        W2=np.full((1, n), 0.5),
        K=np.zeros((n, 1)),
        F=np.zeros((0, 1)),
        constant=np.zeros((n, n)),
        directions=directions,
        ranges=ranges,
    )
    return peak_bound(system, np.full(n, 0.01), [])


def entry(n: int, i: int, j: int) -> np.ndarray:
    return np.outer(np.eye(n)[i], np.eye(n)[j])


def turning(radius: float) -> PeakBound:
    return bare([[0.5, 0.4], [-0.4, 0.5]], [entry(2, 0, 1)], [[-radius, radius]])


def clustered() -> PeakBound:
    A = 0.5 * np.eye(4) + 0.5 * np.eye(4, k=-1)
    return bare(A, [entry(4, 0, 3), entry(4, 2, 2)], [[-0.05, 0.05], [-0.1, 0.02]])


def tanks(given_peak) -> PeakBound:
    return stored_bound(given_peak.certificate.design)


PLANTS = {
    "eigenvectors": (tanks, [1, 2, 2, 1]),
    "a pair": (lambda _: turning(0.2), [2]),
    "schur": (lambda _: clustered(), [1] * 4),
    "exponential": (lambda _: turning(0.4), None),
}
FIRST = {
    6: np.array([5.0, 5.0, 25.0, 5.0, 1.0, 1.0]),
    2: np.array([1.0, 2.0]),
    3: np.ones(3),
    4: np.ones(4),
}


def errors_under(
    peak: PeakBound, s: np.ndarray, output: int, noisy: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Errors of (16) under Jacobians s that are the worst for one at the end, and worse Jacobians.

    Recursion (16) of the unshifted error, so nothing of the shifted system is shared.
    """
    system, steps = peak.system, len(s)
    n, n_f = system.n, system.n_f
    T = np.eye(n) + system.E @ system.C
    M = system.constant + np.tensordot(s, system.directions, axes=1)
    closed = T @ (system.A + M) - system.K @ system.C
    X = np.zeros((steps, n + n_f, n + n_f))
    X[:, :n, :n], X[:, :n, n:] = closed, T @ system.B_f
    X[:, n:, :n], X[:, n:, n:] = -system.F @ system.C, np.eye(n_f)
    now = np.vstack([T @ system.W1 - system.K @ system.W2, -system.F @ system.W2])
    late = np.vstack([system.E @ system.W2, np.zeros((n_f, now.shape[1]))])
    adjoint = np.zeros((steps + 1, n + n_f))
    adjoint[-1, output] = 1.0
    for k in range(steps - 1, -1, -1):
        adjoint[k] = X[k].T @ adjoint[k + 1]
    w = np.sign(adjoint @ late + np.vstack([adjoint[1:] @ now, 0 * now[:1]])) * peak.wbar * noisy
    eps = np.sign(adjoint[1:, n:]) * peak.epsbar * noisy
    # e_0 = zeta_0 + E W2 w_0
    errors = [np.where(adjoint[0] < 0, -1, 1) * FIRST[n + n_f] + late @ w[0]]
    for k in range(steps):
        moved = X[k] @ errors[-1] + now @ w[k] + late @ w[k + 1]
        moved[n:] += eps[k]
        errors.append(moved)
    push = np.einsum(
        "ki,jil,kl->kj", adjoint[1:, :n] @ T, system.directions, np.array(errors)[:-1, :n]
    )
    return np.abs(errors), np.where(push > 0, *system.ranges.T[::-1])


def exceeds(peak: PeakBound, fading: Fading, lengths=(1, 3, 12, 60, 400)) -> bool:
    """Whether an adversary gets beyond the bounds at any instant: held vertices, then switching."""
    system = peak.system
    size = system.n + system.n_f
    mus = [fading.start @ FIRST[size]]
    for _ in range(max(lengths)):
        mus.append(fading.G @ mus[-1])
    added = np.array(mus) @ fading.reach.T
    corners = np.stack(np.meshgrid(*system.ranges, indexing="ij"), -1).reshape(
        -1, len(system.ranges)
    )
    for steps in lengths:
        for corner in corners:
            for output in range(size):
                s = np.tile(corner, (steps, 1))
                for noisy in (False, True, False):
                    errors, s = errors_under(peak, s, output, noisy)
                    limit = added[: steps + 1] + noisy * peak.steady
                    if np.any(errors > limit * (1 + 1e-12) + 1e-14):
                        return True
    return False


@pytest.mark.parametrize("name", PLANTS)
def test_no_adversary_gets_beyond_the_bounds(name, given_peak):
    """Held vertices and switching ones, with the worst disturbances or none, at every k >= 0."""
    make, blocks = PLANTS[name]
    peak = make(given_peak)
    fading = fade(peak, FIRST[len(peak.steady)])
    assert (fading.modes.blocks.tolist() if fading.modes else None) == blocks
    assert all(claim.holds for claim in prove_fading(peak, fading))
    lengths = (1, 3, 12, 60, 400) if name == "eigenvectors" else (1, 2, 3, 6, 12, 30)
    assert not exceeds(peak, fading, lengths)


@pytest.mark.parametrize("name", ["eigenvectors", "a pair", "schur"])
def test_without_the_channels_an_adversary_gets_beyond(name, given_peak):
    """Mutant: G without ``|Y Bp| coupling |Q Y^-1|``; it is not proved either."""
    peak = PLANTS[name][0](given_peak)
    fading = fade(peak, FIRST[len(peak.steady)])
    none = replace(
        peak.system, channels=replace(peak.system.channels, radii=0 * peak.system.channels.radii)
    )
    mutant = replace(fading, G=recursion(none, fading.modes)[0])
    assert exceeds(peak, mutant, (60, 400) if name == "eigenvectors" else (6, 12, 30))
    assert [c.name for c in prove_fading(peak, mutant) if not c.holds] == ["transient"]


@pytest.mark.parametrize("part", ["G", "reach", "start"])
@pytest.mark.parametrize("name", PLANTS)
def test_smaller_numbers_are_exceeded_or_not_proved(name, part, given_peak):
    """Mutants: each of the three matrices a little smaller."""
    peak = PLANTS[name][0](given_peak)
    fading = fade(peak, FIRST[len(peak.steady)])
    mutant = replace(fading, **{part: getattr(fading, part) * (1 - 1e-6)})
    assert "transient" in {claim.name for claim in prove_fading(peak, mutant) if not claim.holds}


def test_the_first_instant_counts_in_an_exponential():
    """Mutant: c(unit_j) alone, which holds from k = 1 on; the third error is gone by then."""
    A = np.array([[0.5, 0.4, 0.0], [-0.4, 0.5, 0.0], [0.0, 0.0, 0.0]])
    peak = bare(A, [entry(3, 0, 1)], [[-0.4, 0.4]])
    fading = fade(peak, FIRST[3])
    assert fading.modes is None
    columns = [transient(peak, unit, decay=fading.G[0, 0]).c for unit in np.eye(3)]
    mutant = replace(fading, start=np.column_stack(columns))
    assert exceeds(peak, mutant, (1,)) and not exceeds(peak, fading, (1, 5))
    assert [c.name for c in prove_fading(peak, mutant) if not c.holds] == ["transient"]


# -- the numbers -------------------------------------------------------------------------------


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    entries=st.lists(st.floats(-1e3, 1e3), min_size=4, max_size=4),
    radius=st.sampled_from([0.0, 1e-3]),
    power=st.sampled_from([0, -300, 300]),
)
def test_norms_of_blocks_are_not_below_the_exact_ones(entries, radius, power):
    """s^2 I - M'M >= 0 in fractions; mutant: nothing added for the radius."""
    middle = np.array(entries).reshape(2, 2) * 2.0**power
    spread = np.full((2, 2), radius * 2.0**power)
    whole = np.array([[0, 1]])
    bound = Fraction(float(block_norms(Enclosure(middle, spread), whole, whole, 1.0)[0, 0]))
    signs = np.where(middle < 0, -1.0, 1.0)
    M = [
        [Fraction(m) + Fraction(r) * int(s) for m, r, s in zip(*rows, strict=True)]
        for rows in zip(middle.tolist(), spread.tolist(), signs.tolist(), strict=True)
    ]
    squares = sum(x * x for row in M for x in row)
    determinant = M[0][0] * M[1][1] - M[0][1] * M[1][0]
    assert 2 * bound**2 >= squares
    assert bound**4 - bound**2 * squares + determinant**2 >= 0
    alone = block_norms(Enclosure(middle, spread), single(2), single(2), 1.0)
    assert np.all(alone >= np.abs(middle) + spread)


@pytest.mark.parametrize("seed", range(4))
def test_the_inverse_is_enclosed(seed):
    """The exact inverse of the stored inverse; mutant: the basis without a radius."""
    rng = np.random.default_rng(seed)
    basis = rng.normal(size=(5, 5)) * 10.0 ** rng.integers(-6, 6, (5, 1))
    inverse = np.linalg.inv(basis) * (1 + 1e-9 * rng.normal(size=(5, 5)))
    modes = Modes(basis, inverse, np.ones(5, dtype=np.int64))
    enclosed = enclosed_inverse(modes)
    exact = ExactMatrix.of(inverse).inverse().to_fractions()
    distance = [
        [abs(x - Fraction(m)) for x, m in zip(*rows, strict=True)]
        for rows in zip(exact, enclosed.mid.tolist(), strict=True)
    ]
    assert all(
        d <= Fraction(r)
        for rows in zip(distance, enclosed.rad.tolist(), strict=True)
        for d, r in zip(*rows, strict=True)
    )
    assert all(
        any(d > Fraction(r) / 100 for d, r in zip(*rows, strict=True))
        for rows in zip(distance, enclosed.rad.tolist(), strict=True)
    )
    assert enclosed_inverse(replace(modes, inverse=0 * inverse)) is None


def test_contraction_is_proved_by_a_vector():
    G = np.array([[0.5, 0.25], [0.0, 0.75]])
    assert contracts(G, 0.7501) and not contracts(G, 0.7499) and not contracts(G, 1.0)
    assert not contracts(np.array([[0.0, 2.0], [0.6, 0.0]]), 0.999)


def test_channels_feed_back_through_what_they_see():
    """G, R and S against their formulas in plain doubles."""
    peak = clustered()
    modes = fade(peak, FIRST[4]).modes
    G, reach, start = recursion(peak.system, modes)
    B, coupling = channel_inputs(peak.system)
    Y, V = modes.inverse, modes.basis
    plain = np.abs(Y @ peak.system.A0.mid @ V) + np.abs(Y @ B.mid) @ coupling @ np.abs(V)
    np.testing.assert_allclose(G, plain, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(reach, np.abs(V), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(start, np.abs(Y), rtol=1e-9, atol=1e-12)


# -- files -------------------------------------------------------------------------------------


def scaled(*path, by):
    def change(bound):
        place = bound["fading"]
        for key in path[:-1]:
            place = place[key]
        place[path[-1]] = (np.array(place[path[-1]]) * by).tolist()

    return change


TAMPERED = {
    "G": (scaled("G", by=1 - 1e-9), {"transient"}),
    "one entry of G": (scaled("G", 1, 1, by=0.99), {"transient"}),
    "larger G": (scaled("G", by=1.1), {"decay"}),
    "reach": (scaled("reach", by=1 - 1e-9), {"transient"}),
    "start": (scaled("start", by=1 - 1e-9), {"transient"}),
    "decay": (scaled("decay", by=0.999), {"decay"}),
    "no decay": (scaled("decay", by=2.0), {"decay"}),
    "basis": (scaled("modes", "basis", 3, by=1.01), {"transient"}),
    "another basis": (scaled("modes", "basis", by=2.0), {"basis", "transient"}),
    "singular inverse": (scaled("modes", "inverse", 0, by=0.0), {"basis", "transient"}),
    "inverse": (scaled("modes", "inverse", 0, by=1.01), {"transient"}),
    "huge inverse": (scaled("modes", "inverse", by=1e300), {"basis", "transient"}),
    "an exponential of that speed": (
        lambda bound: bound["fading"].update(modes=None),
        {"transient"},
    ),
}


@pytest.mark.parametrize("what", TAMPERED)
def test_a_changed_recursion_is_not_certified(given_peak, what, tmp_path):
    change, fails = TAMPERED[what]
    path = tmp_path / "design.json"
    given_peak.save(path)
    stored = json.loads(path.read_text())
    change(stored["bound"])
    path.write_text(json.dumps(stored))
    with pytest.raises(ob.CertificateError) as refusal:
        ob.load(path)
    assert {claim.name for claim in refusal.value.failed} == fails


@pytest.mark.parametrize("blocks", [[2] * 3, [1] * 5, [3] + [1] * 3 + [0] * 2])
def test_blocks_that_do_not_fit_are_refused(given_peak, blocks, tmp_path):
    path = tmp_path / "design.json"
    given_peak.save(path)
    stored = json.loads(path.read_text())
    stored["bound"]["fading"]["modes"]["blocks"] = blocks
    path.write_text(json.dumps(stored))
    with pytest.raises(ob.CertificateError, match="blocks"):
        ob.load(path)


@pytest.mark.parametrize(
    ("blocks", "sound"),
    [
        ([1, 1, 1, 1], True),
        ([2, 1, 1], True),
        ([2, 2], True),
        ([1, 1, 1], False),
        ([2, 2, 1], False),
        ([3, 1], False),
        ([4], False),
        ([0, 2, 2], False),
    ],
)
def test_blocks_of_one_or_two_make_up_the_basis(blocks, sound):
    """Mutants: their sum not asked, or their size."""
    modes = Modes(np.eye(4), np.eye(4), np.array(blocks))
    if sound:
        modes.check()
    else:
        with pytest.raises(ob.CertificateError, match="do not make up 4 columns"):
            modes.check()
