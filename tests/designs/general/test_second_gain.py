"""The gain of predictions: the paper's observer, its published bounds, and what a step does.

Mutants are told beside each test; those of the sums stand in `test_peak_bounds`.
"""

from dataclasses import replace
from fractions import Fraction
from itertools import product

import numpy as np
import pytest
import sympy as sp

import obsynth as ob
from methods import PEAK_GAINS
from obsynth.designs.core.errors import CertificateError, InfeasibleDesign
from obsynth.designs.general.method import GeneralUIO, bound_peak
from obsynth.designs.general.model import read
from obsynth.designs.general.peak import error_sums, spectral_radius
from obsynth.designs.general.record import EllipsoidBound
from obsynth.designs.general.rounding import needed, settle
from obsynth.designs.general.step import stages
from obsynth.designs.general.system import error_system, extra_inputs
from obsynth.symbolic.errors import ObsynthError


@pytest.fixture(scope="module")
def tanks(tank):
    """The design of the given gains, after Buciakowski et al."""
    model = GeneralUIO().read(tank)
    return GeneralUIO().fix(model, {"L": model.design.L0, **PEAK_GAINS})


def digits(text):
    return np.array([float(word) for word in text.split()])


def agrees(value, text):
    """Equal to the digits given, but for the slopes' bounds, which are not quite those of then."""
    places = max(len(word.partition(".")[2]) for word in text.split())
    rounding = 0.50001 * 10.0**-places
    return bool(np.all(np.abs(np.asarray(value) - digits(text)) <= rounding + 5e-8))


def test_the_published_bounds_of_the_given_gains(tanks):
    """Mutants: K with the other sign, without V, without C0; without its share of a channel."""
    system = error_system(tanks)
    sums = error_sums(system, extra_inputs(system, tanks))
    assert agrees(system.of_F.radii, ".00194698 .00974959 .00122372 .00612783")
    n = ".23283510 .23798845 .10000000 .31025503 .75174791 .88902338"
    assert agrees(sums.n, f"{n} {n}")
    assert spectral_radius(sums.G) == pytest.approx(0.6345487807, abs=1e-7)
    b = tanks.bound.b
    assert agrees(b[6:], ".23985572 .28211696 .10000000 1.12410313 .77555366 1.17477582")
    assert b[6:].sum() == pytest.approx(3.69640530, abs=1e-7)
    assert b[:6] == pytest.approx(b[6:], rel=1e-13)
    assert 0.1 <= b[8] < 0.1 + 1e-12


def reached(design, corner, gains, steps):
    """The largest errors [x - xhat; f - fhat] at one Jacobian of the paper's matrices, (n + n_f,).

    Impulse responses of recursion (16) with the error shifted by E y, from the given gains alone.
    """
    J, N, v = design.family.at(corner), design.size, design.v_radius
    A, C, V, H = J[:N, :N], J[N:, :N], J[N:, N:], design.L
    T, Pi = np.eye(N) - H @ C, np.eye(len(C)) - C @ H
    K = T @ np.vstack([gains["K"], gains["F"]]) @ Pi
    closed = T @ A - K @ C
    inputs = T @ J[:N, N:] - closed @ H @ V - K @ V
    total = np.abs(H @ V) @ v
    for _ in range(steps):
        total += np.abs(inputs) @ v
        inputs = closed @ inputs
    return total


def test_what_constant_jacobians_attain(tanks):
    """The published lower bounds, which no bound of the family can be below."""
    corners = [np.array(c) for c in product(*tanks.family.ranges)]
    most = np.max([reached(tanks, corner, PEAK_GAINS, 6000) for corner in corners], axis=0)
    assert agrees(most, ".238914 .244833 .100000 .715622 .770373 .933383")
    assert np.all(most <= tanks.bound.b[6:])


def skewed():
    """An unknown input that two outputs show, so that the paper's H is no single column."""
    plant = ob.Plant("skewed")
    x, z, r = plant.states("x z r", range=(-4, 4))
    (u,) = plant.inputs("u", range=(-1, 1), nominal=0)
    plant.actuator_faults("f", of=u, range=(-1, 1), rate=0.02)
    plant.unknown_inputs("d")
    w = plant.disturbances("w1:4", bound=0.05)
    tenth = sp.Rational(1, 10)
    d = plant.d[0].symbol
    rows = [x / 2 + z * tenth + d, z / 3 + d / 2 + sp.sin(r) * tenth, r / 2 + x * tenth + u]
    plant.dynamics(rows, Ts=1)
    plant.outputs([x + w[0], z + x / 4 + w[1], r + w[2]])
    return plant


SKEWED = {"K": 0.2 * np.eye(3), "F": np.array([[0.02, -0.01, 0.3]])}


def test_the_step_is_the_observer_of_the_paper():
    """z+ = T f(xhat) + T K nu, xhat = z - E y, fhat+ = fhat + F nu; any d, any reading.

    Outside of the range of T, a K only keeps alive an error that is taken away; here it does
    nothing. Mutants: K of the innovation before the unknown input is taken away; K dropped, or with
    the other sign; the step's innovation at the corrected estimate.
    """
    plant = skewed()
    parts = ob.split(plant)
    observer = ob.BoundedErrorUIO(bounds="peak").analyse(parts, SKEWED)
    design = observer.certificate.design
    assert np.any(design.Z) and np.any(design.K)
    first, second, third = stages(design)
    C, D = parts.C, parts.D
    E = -D @ np.linalg.pinv(C @ D)
    T = np.eye(3) + E @ C
    rng = np.random.default_rng(0)
    xhat, fhat = np.array([0.3, -0.2, 0.1]), np.zeros(1)
    p = np.concatenate([xhat, fhat])
    z = T @ xhat
    for _ in range(30):
        u, y = rng.uniform(-1, 1, 1), rng.standard_normal(3)
        xhat = z - E @ y
        c, nu = second(first(p, u, y), u, y)
        assert np.array(c).ravel() == pytest.approx([*xhat, *fhat], rel=1e-9, abs=1e-11)
        p = np.array(third(c, u, nu)).ravel()
        moved = np.array(plant.function()(xhat, u, [0], fhat, np.zeros(3), [], [])[0]).ravel()
        z = T @ (moved + SKEWED["K"] @ (y - C @ xhat))
        fhat = fhat + SKEWED["F"] @ (y - C @ xhat)


def test_without_a_slope_that_varies_the_bounds_are_attained():
    """Mutant: what two outputs show of the unknown input's noise counted in full."""
    design = ob.BoundedErrorUIO(bounds="peak").analyse(skewed(), SKEWED).certificate.design
    ends = design.family.ranges.mean(axis=1)[:, None] * np.ones((1, 2))
    alone = bound_peak(design.changed(family=replace(design.family, ranges=ends)))
    assert alone.bound.b[4:] == pytest.approx(reached(design, ends[:, 0], SKEWED, 400), rel=1e-9)


def test_sets_hold_what_moves_under_the_gains_of_the_paper():
    """Bang-bang noise, faults at their rate, an unknown input of any size."""
    observer = ob.BoundedErrorUIO(bounds="peak", cuts=()).analyse(skewed(), SKEWED)
    plant, rng = observer.model, np.random.default_rng(1)
    x, f, sign = np.zeros(3), np.zeros(1), 1.0
    memory = observer.memory0(x + 0.1, x_range=np.column_stack([x - 0.2, x + 0.2]))
    worst = 0.0
    for k in range(300):
        w = rng.choice([-0.05, 0.05], 3)
        d = rng.choice([-1.0, 1.0], 1)
        u = -0.5 * np.sign(x[2:])
        following, y = plant.function()(x, u, d, f, w, [], [])
        out = [np.array(part).ravel() for part in observer.step(memory, u, y)]
        memory, truth = out[0], np.concatenate([x, f])
        low, high = np.concatenate([out[3], out[5]]), np.concatenate([out[4], out[6]])
        assert np.all((low <= truth) & (truth <= high)) and out[7][0] == 0
        if k > 50:
            worst = max(worst, float((np.abs(2 * truth - low - high) / (high - low)).max()))
        sign = -sign if rng.random() < 0.05 or abs(f[0] + 0.02 * sign) > 1 else sign
        x, f = np.array(following).ravel(), f + 0.02 * sign
    assert worst > 0.5


def busy():
    """One state, and a reading that is exactly it but for what rounding makes of the terms."""
    plant = ob.Plant("busy")
    (x,) = plant.states("x", range=(-1, 1))
    (w,) = plant.disturbances("w", bound=0.1)
    plant.dynamics([x / 2 + w], Ts=1)
    plant.outputs([x + 200 * (sp.cos(x) ** 2 + sp.sin(x) ** 2 - 1) + w])
    return plant


def test_rounding_of_the_innovation_counts_in_the_prediction():
    """Exact rationals beside doubles. Mutant: without |K| times the innovation's rounding."""
    design = read(busy()).design.changed(K=np.array([[0.5]]))
    _, second, third = stages(design)
    found, worst = needed(design), 0.0
    for x, y in np.random.default_rng(0).uniform(-1, 1, (2000, 2)):
        c, nu = second(x, [], y)
        exact = Fraction(x) / 2 + (Fraction(y) - Fraction(x)) / 2
        worst = max(worst, abs(float(Fraction(float(third(c, [], nu))) - exact)))
    assert 0.005 * found.p[0] <= worst <= found.p[0]
    assert np.all(settle(design).rounding.p >= found.p)


def test_gains_are_given_and_shown_by_the_letters_of_the_paper(tanks, tank):
    model = GeneralUIO().read(tank)
    shown = GeneralUIO.CONTRACT.numbers(tanks).gains
    assert all(np.array_equal(shown[name], PEAK_GAINS[name]) for name in ("K", "F"))
    again = GeneralUIO().fix(model, shown)
    assert np.array_equal(again.bound.b, tanks.bound.b)
    with pytest.raises(ObsynthError, match="needs F"):
        GeneralUIO().fix(model, {"L": tanks.L, "K": PEAK_GAINS["K"]})
    with pytest.raises(ObsynthError, match='or bounds="peak"'):
        GeneralUIO(bounds="l2").fix(model, {"L": tanks.L, **PEAK_GAINS})


@pytest.mark.parametrize(("label", "more"), [("m22(h2)", 0.3), ("m44(h4)", 0.02)])
def test_slopes_that_vary_too_much_are_refused_by_the_state_they_act_through(tanks, label, more):
    """Mutant: the error that is moved most in place of the one that moves most."""
    family = tanks.family
    ranges = family.ranges.copy()
    ranges[family.labels.index(label)] += [-more, more]
    with pytest.raises(InfeasibleDesign, match=f"the error of {label[4:6]}") as caught:
        bound_peak(tanks.changed(family=replace(family, ranges=ranges)))
    assert caught.value.rho > 1


def test_a_start_may_be_the_z_of_the_paper(given_peak):
    """Mutant: the guess in its place."""
    memory = given_peak.memory0([90, 90, 30, 30], z0=[100, 110, 0, 40])
    first = memory[given_peak.memory_layout["prediction"]]
    assert first.tolist() == [100, 110, 0, 40, 0, 0]
    with pytest.raises(ObsynthError, match="z0 has to be 4"):
        given_peak.memory0([90, 90, 30, 30], z0=[1.0])


def test_a_stored_gain_of_predictions_goes_with_peak_bounds(tanks):
    """Mutant: not asked, so that an ellipsoid of other errors is believed."""
    tanks.check()
    N = tanks.size
    other = EllipsoidBound(np.eye(N), 0.1, np.zeros(0), np.zeros(0), np.ones(N))
    with pytest.raises(CertificateError, match="peak bounds alone"):
        replace(tanks, bound=other).check()
    replace(tanks, bound=other, K=np.zeros_like(tanks.K)).check()


def test_a_changed_gain_of_predictions_is_noticed(tanks):
    """Mutants: sums or recursion without K."""
    contract = GeneralUIO.CONTRACT
    assert contract.certify(tanks, "lmi").valid
    for factor in (0.0, 0.999, -1.0):
        claims = contract.certify(tanks.changed(K=factor * tanks.K), "lmi")
        failed = {claim.name for claim in claims if not claim.holds}
        assert "peak" in failed
    slower = bound_peak(tanks.changed(K=0.9 * tanks.K)).bound.fading
    mixed = replace(tanks.bound, fading=slower)
    failed = {c.name for c in contract.certify(tanks.changed(bound=mixed), "lmi") if not c.holds}
    assert "transient" in failed
