"""Ellipsoids and energy gains of the general class against what the errors do, computed otherwise.

Mutants, each of which fails here: a channel of F or of h dropped; delta and delta' taken as one; v
counted once where it enters rows and outputs; the continuation outside the box left out; the rest
of the family, or rounding, left out of the proof.
"""

import functools
from dataclasses import replace
from itertools import product

import casadi as ca
import numpy as np
import pytest
import sympy as sp

import obsynth as ob
from methods import observer_of
from obsynth.designs.core.boxes import Ends
from obsynth.designs.core.errors import CertificateError, InfeasibleDesign, SolverTrouble
from obsynth.designs.general.claims import claims
from obsynth.designs.general.lmis import rounding_in
from obsynth.designs.general.method import GeneralUIO
from obsynth.designs.general.record import Rounding
from obsynth.designs.general.step import running, stages, start_bound
from obsynth.designs.general.storage import attained_gain, prove_storage
from obsynth.designs.general.system import error_system

ELLIPSOID, L2 = GeneralUIO(bounds="ellipsoid"), GeneralUIO(bounds="l2")
R = sp.Rational


def scalar(sign=1, touched=0):
    """One state; the same w in row and output; both slopes vary, by w too if touched."""
    plant = ob.Plant("scalar")
    (x,) = plant.states("x", range=(-1, 1))
    (w,) = plant.disturbances("w", bound=0.1)
    bend = sp.sin(3 * x)
    plant.dynamics([R(6, 10) * x + sign * bend / 30 + w * (1 + touched * x)], Ts=1)
    plant.outputs([x + bend / 20 + w * (1 + touched * x)])
    return plant


def oscillator():
    """Van der Pol's, with a force fault."""
    plant = ob.Plant("oscillator")
    x, v = plant.states("x v", range=[(-2.5, 2.5), (-4, 4)], nominal=0)
    (u,) = plant.inputs("u", range=(-1, 1), nominal=0)
    plant.actuator_faults("f", of=u, range=(-1, 1), rate=0.5)
    w = plant.disturbances("w1:3", bound=[0.005, 0.02])
    plant.dynamics([v, (1 - x**2) * v - x + u])
    plant.outputs([x + w[0], v + w[1]])
    return plant.discretise("euler", Ts=R(1, 100))


def cruise():
    plant = ob.Plant("cruise control")
    (v,) = plant.states("v", range=(5, 40), nominal=20)
    (u,) = plant.inputs("u", range=(0, 1), nominal=0.3)
    plant.actuator_faults("f", of=u, range=(-0.5, 0.5), rate=0.05)
    w = plant.disturbances("w1 w2", bound=[0.2, 0.05])
    torque = 190 * (1 - R(4, 10) * (R(12, 420) * v - 1) ** 2)
    drag = R(32, 100) * R(13, 10) * R(24, 10) / 2 * v**2
    plant.dynamics([(12 * torque * u - 1600 * R(98, 1000) - drag) / 1600 + w[0]])
    plant.outputs([v + w[1]])
    return plant.discretise("euler", Ts=R(1, 10))


def battery():
    """A nonlinear output with feedthrough."""
    plant = ob.Plant("battery")
    z, v1 = plant.states("soc v1", range=[(0.1, 0.95), (-0.2, 0.2)], nominal=[0.5, 0])
    (current,) = plant.inputs("I", range=(-5, 5), nominal=0)
    plant.actuator_faults("f", of=current, range=(-1, 1), rate=0.01)
    (w,) = plant.disturbances("w", bound=0.005)
    open_voltage = R(34, 10) + R(11, 10) * z - R(9, 10) * z**2 + R(6, 10) * z**3
    plant.dynamics([-current / 7200, -v1 / 36 + current / 2400])
    plant.outputs([open_voltage - v1 - R(2, 100) * current + w])
    return plant.discretise("euler", Ts=1)


def shares(observer):
    """Half widths of the ellipsoid alone over half ranges."""
    signals = (*observer.model.x, *observer.model.f)
    half = np.array([0.5 * (s.upper - s.lower) for s in signals])
    return running(observer.certificate.design)[0].steady / half


# -- numbers -----------------------------------------------------------------------------------

WIDTHS = [(oscillator, 0.424), (cruise, 0.702), (battery, 1.245)]


@pytest.mark.parametrize(("plant", "fault"), WIDTHS)
def test_fault_widths_are_those_of_the_reference(plant, fault):
    """Mutant: gamma ten times too small."""
    assert shares(ELLIPSOID.design(plant()))[-1] <= 1.03 * fault


@pytest.mark.parametrize(
    ("plant", "level", "attained"),
    [
        (oscillator, 0.17012, 0.16766),
        (cruise, 0.39926, 0.39913),
        (battery, 0.17056, 0.16760),
    ],
)
def test_energy_gains_are_those_of_the_reference(plant, level, attained):
    found = L2.design(plant()).performance
    assert found["l2_gain"] == pytest.approx(level, rel=1e-3)
    assert found["attained_gain"] == pytest.approx(attained, rel=1e-3)
    assert found["attained_gain"] <= found["l2_gain"]


def test_units_do_not_matter():
    """The oscillator in units of 10^4 and 10^-4. Mutant: P scaled by ones in place of bounds."""
    plant = ob.Plant("oscillator in other units")
    a, b = 10**4, 10**3
    x, v = plant.states("x v", range=[(-2.5 * a, 2.5 * a), (-4.0 / b, 4.0 / b)], nominal=0)
    (u,) = plant.inputs("u", range=(-1, 1), nominal=0)
    plant.actuator_faults("f", of=u, range=(-1, 1), rate=0.5)
    w = plant.disturbances("w1:3", bound=[0.005 * 1e-4, 0.02])
    X, V = x / a, v * b
    plant.dynamics([a * V, ((1 - X**2) * V - X + u) / b])
    plant.outputs([X / 10**4 + w[0], V + w[1]])
    there = ELLIPSOID.design(plant.discretise("euler", Ts=R(1, 100)))
    np.testing.assert_allclose(shares(there), shares(ELLIPSOID.design(oscillator())), rtol=1e-4)


# -- the errors, computed otherwise ------------------------------------------------------------


def worst(Z, middle, reach, apart, w=0.1):
    """The largest |e_c| of one state: corners of all signs, again and again.

    apart: whether w has one sign in the output and another in the row that follows
    """
    (A, W), (C, V) = middle
    (a, b), (c, d) = reach
    signs = np.array(list(product((-1.0, 1.0), repeat=6))).T
    row = signs[5] if apart else signs[0]
    p = most = 0.0
    for _ in range(400):
        e = (1 - Z * (C + c * signs[1])) * p - Z * (V + d * signs[2]) * signs[0] * w
        most = max(most, np.abs(e).max())
        p = np.abs((A + a * signs[3]) * e + (W + b * signs[4]) * row * w).max()
    return most


@pytest.mark.long
@pytest.mark.parametrize("Z", [0.2, 0.45, 0.8])
@pytest.mark.parametrize(("sign", "touched"), [(1, 0), (-1, 0), (1, 2), (-1, 2)])
def test_widths_of_one_state_are_above_the_worst_and_near_it(Z, sign, touched):
    """Near what is reached where w counts twice."""
    design = ELLIPSOID.analyse(scalar(sign, touched), {"L": [[Z]]}).certificate.design
    half = 0.5 * np.diff(design.family.ranges, axis=1)[:, 0]
    reach = np.tensordot(half, np.abs(design.family.directions), axes=1)
    least, most = (worst(Z, design.middle, reach, apart) for apart in (False, True))
    found = running(design)[0].steady[0]
    assert least <= found <= 1.1 * most
    assert found >= most * (1.0 - 1e-6)


def corner(family, rng):
    """A Jacobian all of whose columns have corners of their own."""
    found = family.constant.copy()
    for (low, high), direction in zip(family.ranges, family.directions, strict=True):
        pick = rng.integers(0, 2, direction.shape[1])
        found = found + np.where(pick, high, low) * direction
    return found


def supply(design, v, w):
    """What V may grow by at v_k = v and v_{k+1} = w, in units of their bounds, and keep."""
    J = np.abs(design.family.constant) + np.abs(design.family.directions).sum(axis=0)
    N, live = design.size, design.v_radius > 0.0
    before = np.flatnonzero(J[:N, N:].any(axis=0) & live)
    after = np.flatnonzero(J[N:, N:].any(axis=0) & live)
    both = np.vstack([v[before], w[after]])
    if design.bound.KIND == "l2":
        return design.bound.mu**2 * (both**2).sum(axis=0), 1.0
    return design.bound.noise @ both**2, 1.0 - design.bound.gamma


def growth(design, following, e, v, w):
    """V+ - keep V - supply (+ the energy of the errors): not positive."""
    P = design.bound.P
    supplied, keep = supply(design, v, w)
    V, V_next = (np.einsum("ik,ij,jk->k", s, P, s) for s in (e, following))
    spent = 0.0
    if design.bound.KIND == "l2":
        spent = ((design.bound.weights[:, None] * e) ** 2).sum(axis=0)
    return (V_next + spent - keep * V - supplied) / (keep * V + supplied)


def drawn(design, rng, count=400):
    """Errors with V up to 1, and v_k, v_{k+1} in [-1, 1]."""
    root = np.linalg.inv(np.linalg.cholesky(design.bound.P)).T
    e = rng.standard_normal((design.size, count))
    e = root @ (e / np.linalg.norm(e, axis=0)) * rng.uniform(0.01, 1.0, count)
    scale = rng.choice([0.0, 0.3, 1.0], (2, 1, count))
    v = scale * rng.choice([-1.0, 1.0], (2, len(design.v_radius), count))
    return e, *v


@pytest.mark.parametrize("name", ["motor", "l2", "shared"])
def test_the_inequality_holds_for_jacobians_of_rows_and_outputs_apart(name):
    """Worst errors and disturbances of each pair of Jacobians, by its largest eigenvalue."""
    design = design_of(name)
    rng, N = np.random.default_rng(0), design.size
    n_v, radius = len(design.v_radius), design.v_radius
    most = -np.inf
    for _ in range(150):
        (A, W), (C, V) = (
            np.split(part, [N], axis=1)
            for part in (corner(design.family, rng)[:N], corner(design.family, rng)[N:])
        )
        kept = np.eye(N) - design.Z @ C
        T = np.eye(N) - design.L0 @ C
        shown = kept @ design.L0 @ V + design.Z @ V
        G = np.hstack([kept @ T @ A, kept @ T @ W * radius, -shown * radius])
        e, v, w = (
            np.eye(N + 2 * n_v)[part]
            for part in (slice(N), slice(N, N + n_v), slice(N + n_v, None))
        )
        ends = np.linalg.eigh(_form(design, G, e, v, w))
        most = max(most, ends[0][-1])
    assert most <= 0.0


def _form(design, G, e, v, w):
    """The quadratic form whose eigenvalues must not be positive, scaled."""
    N, P = design.size, design.bound.P
    spent = np.zeros((N, N))
    levels, keep = [], 1.0
    for unit in np.eye(len(v)):
        before = supply(design, unit[:, None], np.zeros((len(v), 1)))
        after = supply(design, np.zeros((len(v), 1)), unit[:, None])
        levels.append((before[0][0], after[0][0]))
        keep = before[1]
    if design.bound.KIND == "l2":
        spent = np.diag(design.bound.weights**2)
    given = np.concatenate(np.array(levels).T)
    form = G.T @ P @ G
    form[:N, :N] += spent - keep * P
    form[N:, N:] -= np.diag(given)
    size = np.sqrt(np.concatenate([np.diag(P), np.maximum(given, 1e-12)]))
    used = np.concatenate([np.ones(N, bool), given > 0.0])
    assert np.all(np.abs(G[:, ~used]) <= 1e-12 * np.abs(G).max())
    return (form / np.outer(size, size))[np.ix_(used, used)]


def moved(design, x, xhat, u, v, w, rng):
    """One step of plant and observer, columns of trials: x - xhat afterwards."""
    plant, count = design.extended.plant, x.shape[1]
    none = np.zeros((0, count))
    noise = [design.v_centre[:, None] + design.v_radius[:, None] * part for part in (v, w)]
    u = np.repeat(u[:, None], count, axis=1)
    D0 = np.array(design.extended.D0.evalf(17).tolist(), dtype=float).reshape(len(x), -1)
    first, second, third = (stage.map(count) for stage in stages(design))
    step = plant.function().map(count)
    # an unknown input of any size: x = T0 F + what L0 reads of C x
    after = np.array(step(x, u, none, none, noise[0], none, none)[0])
    after = after + D0 @ rng.standard_normal((D0.shape[1], count))
    y = step(after, u, none, none, noise[1], none, none)[1]
    moved = third(xhat, u, np.zeros(y.shape))
    return after - np.array(second(first(moved, u, y), u, y)[0])


def bent():
    """Two states whose slopes differ most at the ends of the box, noise as large as the box."""
    plant = ob.Plant("bent")
    x, z = plant.states("x z", range=[(-1, 1), (-1, 1)])
    w = plant.disturbances("w1 w2", bound=[0.4, 0.2])
    plant.dynamics(
        [
            R(9, 10) * x + R(3, 10) * z - x**3 / 6 + w[1],
            R(-3, 10) * x + R(8, 10) * z + z**3 / 9,
        ],
        Ts=1,
    )
    plant.outputs([x + x**3 / 9 + w[0]])
    return plant


def shared():
    """One noise in both outputs, of which one takes the unknown input away."""
    plant = ob.Plant("shared")
    x, z = plant.states("x z", range=[(-1, 1), (-1, 1)])
    (d,) = plant.unknown_inputs("d")
    w = plant.disturbances("w1 w2", bound=[0.1, 0.01])
    plant.dynamics([x / 2 + z / 3 + d, x / 4 + R(9, 10) * z + sp.sin(x) / 10 + w[1]], Ts=1)
    plant.outputs([x + w[0], z + x / 2 + w[0]])
    return plant


@functools.cache
def design_of(name):
    if name == "l2":
        return observer_of("general_uio.l2").certificate.design
    if name == "shared":
        return ELLIPSOID.design(shared()).certificate.design
    if name == "motor":
        return observer_of("general_uio.ellipsoid").certificate.design
    if name == "scalar":
        return ELLIPSOID.analyse(scalar(touched=2), {"L": [[0.5]]}).certificate.design
    return ELLIPSOID.design(bent()).certificate.design


@pytest.mark.parametrize("name", ["bent", "motor"])
def test_estimates_outside_the_box_keep_the_inequality(name):
    """Mutants: rows or outputs at the clipped estimate alone, or at the estimate as it is."""
    design, rng = design_of(name), np.random.default_rng(1)
    plant, count = design.extended.plant, 2000
    box = np.where(np.isfinite(plant.box("x")), plant.box("x"), [-1.0, 1.0])
    e, v, w = drawn(design, rng, count)
    pick = rng.integers(0, 3, (design.size, count))
    x = np.select([pick == 0, pick == 1], [box[:, :1], box[:, 1:]], box.mean(axis=1)[:, None])
    u = np.array([s.nominal for s in plant.u], dtype=float)
    xhat = x - e
    outside = ((xhat < box[:, :1]) | (xhat > box[:, 1:])).any(axis=0)
    assert outside.mean() > 0.3
    following = moved(design, x, xhat, u, v, w, rng)
    assert growth(design, following, e, v, w).max() <= 1e-9


# -- what is proved ----------------------------------------------------------------------------


@pytest.fixture
def ellipsoid():
    return design_of("motor")


def fallen(design, **changes):
    """Names of the claims that fall where the stored bound is changed; none has a margin."""
    changed = replace(design, bound=replace(design.bound, **changes))
    failed = [claim for claim in prove_storage(changed) if not claim.holds]
    assert all(claim.margin < 0.0 for claim in failed)
    return {claim.name for claim in failed}


def test_every_number_of_an_ellipsoid_is_proved(ellipsoid):
    """Mutants: a claim that holds whatever is stored."""
    bound = ellipsoid.bound
    assert not fallen(ellipsoid)
    assert fallen(ellipsoid, P=1.01 * bound.P) == {"lmi"}
    assert fallen(ellipsoid, gamma=bound.gamma * (1.0 + 1e-3)) == {"lmi"}
    assert "weights" in fallen(ellipsoid, gamma=bound.gamma * (1.0 - 1e-6))
    assert "weights" in fallen(ellipsoid, noise=bound.noise * (1.0 + 1e-6))
    for i in range(ellipsoid.size):
        less = bound.inverse_diagonal.copy()
        less[i] *= 1.0 - 1e-5
        assert fallen(ellipsoid, inverse_diagonal=less) == {"half_widths"}
    for k in range(len(bound.tau)):
        tau = bound.tau.copy()
        tau[k] *= -1.0
        assert "weights" in fallen(ellipsoid, tau=tau)
    for short in (bound.noise[:-1], bound.tau[:-1]):
        name = "noise" if len(short) + 1 == len(bound.noise) else "tau"
        with pytest.raises(CertificateError):
            fallen(ellipsoid, **{name: short})


def test_every_number_of_an_energy_gain_is_proved():
    design = observer_of("general_uio.l2").certificate.design
    bound = design.bound
    assert not fallen(design)
    assert fallen(design, mu=bound.mu * (1.0 - 1e-3)) == {"lmi"}
    assert fallen(design, mu=-bound.mu) == {"multipliers"}
    assert fallen(design, weights=bound.weights * (1.0 + 1e-3)) == {"lmi"}
    for k in range(len(bound.tau)):
        tau = bound.tau.copy()
        tau[k] *= -1.0
        assert "multipliers" in fallen(design, tau=tau)
    with pytest.raises(CertificateError):
        fallen(design, tau=bound.tau[:-1])


def test_the_rest_of_the_family_is_part_of_the_proof(ellipsoid):
    """Mutant: the radius of an entry left out of the enclosures."""
    N = ellipsoid.size
    for i, j in ((0, 0), (0, N + 4), (N, 0), (N, N)):
        family = ellipsoid.family
        radius = family.radius.copy()
        radius[i, j] += 5.0
        wide = replace(ellipsoid, family=replace(family, radius=radius))
        fell = {claim.name for claim in prove_storage(wide) if not claim.holds}
        assert fell == {"lmi"}, (i, j)
    # a disturbance that no row knew
    radius = ellipsoid.family.radius.copy()
    radius[0, N] = 0.2
    wide = replace(ellipsoid, family=replace(ellipsoid.family, radius=radius))
    with pytest.raises(CertificateError, match="4 weights; the error system has 5"):
        list(prove_storage(wide))


@pytest.mark.parametrize("name", ["bent", "motor"])
def test_rounding_enters_the_recursion(name):
    """Corners of all allowances, moved through exact maps. Mutant: one stage left out."""
    ellipsoid = design_of(name)
    rng, N = np.random.default_rng(2), ellipsoid.size
    allowed = Rounding(*(rng.uniform(0.0, 1e-6, (3, N))))
    system = error_system(ellipsoid)
    bound = rounding_in(system, allowed)
    most = np.zeros(N)
    for _ in range(300):
        q, c, p = (part * rng.choice([-1.0, 1.0], N) for part in (allowed.q, allowed.c, allowed.p))
        C = corner(ellipsoid.family, rng)[N:, :N]
        step = (np.eye(N) - ellipsoid.Z @ C) @ (q + system.T.mid @ p) + c
        most = np.maximum(most, np.abs(step))
    assert np.all(most <= bound) and np.all(bound <= 3.0 * most)
    for stage in ("q", "c", "p"):
        less = replace(allowed, **{stage: np.zeros(N)})
        assert np.all(rounding_in(system, less) <= bound)
    wide = replace(ellipsoid, rounding=Rounding(*(1e-3 * np.ones((3, N)))))
    assert np.all(running(wide)[0].steady > running(ellipsoid)[0].steady)


@pytest.mark.parametrize("name", ["bent", "motor", "scalar"])
def test_a_first_set_holds_the_errors_after_the_first_reading(name):
    """Mutant: s of the prediction's errors alone, without what v and the channels add."""
    ellipsoid = design_of(name)
    rng, N, n = np.random.default_rng(3), ellipsoid.size, len(ellipsoid.plant.x)
    for size in (0.0, 1e-3, 1.0):
        half = size * rng.uniform(0.5, 1.0, N)
        ends = np.column_stack([-half, half])
        s = start_bound(ellipsoid, Ends.of(ends[:n]), Ends.of(ends[n:]), ca.SX(ca.DM.zeros(N)))
        found = float(ca.evalf(s)[0])
        most = 0.0
        for _ in range(400):
            J = corner(ellipsoid.family, rng)
            C, V = J[N:, :N], J[N:, N:]
            v = ellipsoid.v_radius * rng.choice([-1.0, 1.0], len(ellipsoid.v_radius))
            e_q = half * rng.choice([-1.0, 1.0], N)
            e_q = e_q - ellipsoid.L0 @ (C @ e_q + V @ v)
            e = e_q - ellipsoid.Z @ (C @ e_q + V @ v)
            most = max(most, float(e @ ellipsoid.bound.P @ e))
        assert most <= found <= 12.0 * most


# -- cut with peak bounds ----------------------------------------------------------------------


def turning(bend):
    """Errors that turn: sums of absolute responses are far above what an energy says."""
    plant = ob.Plant("turning")
    x, z = plant.states("x z", range=[(-1, 1), (-1, 1)])
    w = plant.disturbances("w1 w2", bound=[0.4, 0.2])
    plant.dynamics([x / 2 + R(8, 10) * z + w[1], R(-8, 10) * x + z / 2 + R(bend, 100) * z**2], Ts=1)
    plant.outputs([x + w[0]])
    return plant


def test_ellipsoids_are_cut_with_peak_bounds_of_the_same_gain_where_small_gain_holds():
    """Mutants: no peak bounds; those that fail taken for a refusal of the ellipsoid."""
    for bend, cut in ((3, True), (4, False)):
        observer = ELLIPSOID.analyse(turning(bend), {"L": [[1e-3], [0.0]]})
        design, names = observer.certificate.design, [c.name for c in observer.certificate]
        assert (design.bound.peak is not None) == cut == ("small_gain" in names)
        assert ("ellipsoidal and peak" in observer.guarantee.claims[0]) == cut
    own, peak = (bound.steady for bound in running(design_of("bent")))
    found = ELLIPSOID.design(bent()).performance["core_half_widths"]
    assert np.array_equal(found, np.minimum(own, peak)) and np.any(peak < 0.95 * own)


def test_the_peak_bounds_of_an_ellipsoid_are_proved_as_stored(ellipsoid):
    """Mutant: claims of the ellipsoid alone."""
    peak = ellipsoid.bound.peak

    def fell(changed):
        design = replace(ellipsoid, bound=replace(ellipsoid.bound, peak=changed))
        return {claim.name for claim in claims(design) if not claim.holds}

    assert not fell(peak)
    assert fell(replace(peak, b=0.99 * peak.b)) == {"peak"}
    for part in ("G", "reach", "start"):
        less = {part: 0.99 * getattr(peak.fading, part)}
        assert fell(replace(peak, fading=replace(peak.fading, **less))) == {"transient"}
    record = ellipsoid.to_record()
    assert GeneralUIO.CONTRACT.record.from_record(record).bound.peak.b.tolist() == peak.b.tolist()


def test_sets_are_the_smaller_ones_of_both_at_every_call():
    """Mutants: the larger; peak bounds or ellipsoids that do not fade; one of them alone."""
    ellipsoid = design_of("bent")
    observer = GeneralUIO.CONTRACT.certify(
        replace(ellipsoid, options=GeneralUIO(cuts=(), horizon=99).options())
    ).observer()
    plant, N = observer.model, ellipsoid.size
    box, still = np.array([[-1.0, 1.0]] * 2), np.zeros((0, 2))
    memory = observer.memory0(np.zeros(2), x_range=box, f_range=still)
    both = running(ellipsoid)
    ends = [Ends.of(part) for part in (box, still)]
    first = np.array(ca.evalf(start_bound(ellipsoid, *ends, ca.SX(ca.DM.zeros(N))))).ravel()
    parts, smaller = np.split(first, [1]), set()
    for k in range(60):
        out = observer.step(memory, [], np.zeros(len(plant.output_names)))
        memory, low, high = out[0], *(np.array(out[i]).ravel() for i in (3, 4))
        halves = [bound.half_widths(s)[:2] for bound, s in zip(both, parts, strict=True)]
        least = np.minimum(np.minimum(*halves), np.inf if k else 1.0)
        assert 0.5 * (high - low) == pytest.approx(least, rel=1e-9), k
        smaller |= set(np.argmin(halves, axis=0).tolist())
        parts = [bound.decay @ s + bound.offset for bound, s in zip(both, parts, strict=True)]
    assert smaller == {0, 1}


# -- refusals ----------------------------------------------------------------------------------


def hidden_growth():
    """A state that grows while a second, whose sign nobody knows, carries it to the output."""
    plant = ob.Plant("hidden growth")
    x, z = plant.states("x z", range=[(-1, 1), (-1, 1)])
    w = plant.disturbances("w1 w2", bound=0.01)
    plant.dynamics([R(12, 10) * x + w[1], z * x + R(1, 2) * z], Ts=1)
    plant.outputs([z + w[0]])
    return plant


def test_infeasible_is_what_exact_arithmetic_shows():
    with pytest.raises((InfeasibleDesign, SolverTrouble, ob.StructureError)) as refusal:
        ELLIPSOID.design(hidden_growth())
    assert isinstance(refusal.value, InfeasibleDesign | ob.StructureError)


def test_a_gamma_that_is_too_large_is_said_to_be():
    with pytest.raises((InfeasibleDesign, SolverTrouble), match=r"gamma = 0\.9") as refusal:
        GeneralUIO(bounds="ellipsoid", gamma=0.9).design(battery())
    assert "gamma=" in str(refusal.value) or "peak" in str(refusal.value)


def test_gamma_is_of_ellipsoids_only():
    with pytest.raises(ob.ObsynthError, match="gamma"):
        GeneralUIO(bounds="l2", gamma=0.1)


def test_without_a_followed_fault_there_is_no_fault_error():
    with pytest.raises(ob.StructureError, match="scalar has no fault"):
        L2.design(scalar())
    found = GeneralUIO(bounds="l2", weights=(1.0,)).design(scalar())
    assert "1 (x - xhat)" in found.guarantee.claims[0]
    assert attained_gain(found.certificate.design, np.ones(1)) <= found.performance["mu"]


def test_the_guarantee_names_what_counts_twice():
    said = observer_of("general_uio.l2").guarantee.claims[0]
    assert "0.25 (f - fhat)" in said and "step_f / 0.08" in said and "n3 / 0.05" in said
    assert observer_of("general_uio.l2").half_widths is not None
    assert "core_half_widths" not in observer_of("general_uio.l2").performance
