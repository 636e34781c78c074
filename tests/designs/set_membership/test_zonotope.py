"""Every operation on zonotopes against exact rationals: the exact set lies in the returned one.

With matching generators that is one inequality in what rounding left: what centres and generators
lost is within the slack. For a parallelotope and for a strip it is necessary as well.
"""

from fractions import Fraction as Q

import casadi as ca
import numpy as np
import pytest

from obsynth.derive.rigour import product_up
from obsynth.designs.core.boxes import Ends
from obsynth.designs.set_membership.synthesis import frame, off_identity
from obsynth.designs.set_membership.zonotope import (
    Frame,
    Strips,
    Zonotope,
    corrected,
    cut,
    moved,
    reduced,
)

N, M, OUT, COUNT = 3, 7, 2, 30
KINDS = ["plain", "wide", "cancelling", "tiny", "far"]


def numbers(rng, kind, *shape):
    """Numbers of about one, of very different sizes, near powers of two, below normal, far out."""
    plain = rng.uniform(-1.0, 1.0, shape)
    if kind == "wide":
        return plain * 10.0 ** rng.uniform(-12, 12, shape) * (rng.random(shape) < 0.8)
    if kind == "cancelling":
        return rng.choice([-1.0, 1.0], shape) * (1.0 + rng.integers(-3, 4, shape) * 2.0**-52)
    if kind == "tiny":
        return plain * 10.0 ** rng.choice([-320, -312, -162, -155, 0])
    if kind == "far":
        return np.where(rng.random(shape) < 0.3, 1e100 * np.sign(plain), plain)
    return plain


def exact(array):
    """An array of rationals."""
    return np.vectorize(Q, otypes=[object])(np.asarray(array, float))


def total(array):
    """Row sums of absolute values."""
    return np.abs(array).sum(axis=1)


def cases(kind, count=COUNT):
    """Numbers of (c, G, slack, H, y, o, sigma, L, used), slack and sigma often zero."""
    rng = np.random.default_rng(KINDS.index(kind))
    for _ in range(count):
        zero = rng.random() < 0.7
        parts = [numbers(rng, kind, *s) for s in ((N,), (N, M), (N,), (OUT, N))]
        rest = [numbers(rng, kind, OUT) for _ in range(3)]
        parts[2], rest[2] = np.abs(parts[2]) * (not zero), np.abs(rest[2]) * (not zero)
        L = numbers(rng, "plain" if kind == "far" or rng.random() < 0.3 else kind, N, OUT)
        if kind == "tiny" and rng.random() < 0.5:  # a set of numbers below the normal ones
            parts = [*(10.0**-312 * rng.uniform(-1, 1, p.shape) for p in parts[:3]), parts[3]]
            parts[2:] = np.abs(parts[2]) * (not zero), rng.uniform(-1, 1, parts[3].shape)
        yield (*parts, *rest, L, (rng.random(OUT) < 0.8).astype(float))


def symbols(*shapes):
    return [ca.SX.sym("s", *shape) for shape in shapes]


def numeric(function, *given):
    """Call a function of numbers; arrays of its outputs."""
    found = function(*given)
    return [np.array(v) for v in (found if isinstance(found, tuple) else (found,))]


def build():
    c, G, s, H, y, o, sigma, L, used = symbols(
        (N,), (N, M), (N,), (OUT, N), (OUT,), (OUT,), (OUT,), (N, OUT), (OUT,)
    )
    z = Zonotope(c, G, s)
    strips = Strips.read(z, H, y - o, sigma, used)
    after = corrected(z, L, strips, used)
    ends = cut(z, strips, used)
    given = [c, G, s, H, y, o, sigma, L, used]
    read = [strips.innovation, strips.seen, strips.sigma, strips.against]
    told = [ends.lower, ends.upper, z.hull.lower, z.hull.upper]
    return ca.Function("f", given, [*read, *told, after.centre, after.generators, after.slack])


STEP = build()


@pytest.mark.parametrize("kind", KINDS)
def test_strips_corrections_and_hulls_hold_the_exact_sets(kind):
    """Mutants: the rounding of a strip, of a correction, its sigma; a hull cut short."""
    for given in cases(kind):
        found = numeric(STEP, *given)
        c, G, s, H, y, o, sigma, L, used = map(exact, given)
        b, a, wide, against, _, _, low, high, centre, generators, slack = map(exact, found)
        b, wide, used = b[:, 0], wide[:, 0], used == 1
        lost = np.abs(y - o - H @ c - b) + total(H @ G - a) + np.abs(H) @ s + sigma
        assert (lost <= wide)[used].all() and (b[~used] == 0).all()
        assert not (against[0, 0] and (np.abs(b) <= total(a) + wide).all())
        reach = total(G) + s
        assert (low[:, 0] <= c - reach).all() and (c + reach <= high[:, 0]).all()
        gain = L * used
        lost = np.abs(c + gain @ b - centre[:, 0]) + total(G - gain @ a - generators[:, OUT:])
        lost += total(gain * wide - generators[:, :OUT]) + s
        assert (lost <= slack[:, 0]).all()


def farthest(c, g, s, a, b, sigma):
    """The largest ``c + g xi + s`` with |b - a xi| <= sigma, by its dual, in rationals."""
    gains = [Q(0), *(p / q for p, q in zip(g, a, strict=True) if q)]
    return min(c + lam * b + np.abs(g - lam * a).sum() + abs(lam) * sigma + s for lam in gains)


@pytest.mark.parametrize("kind", KINDS)
def test_a_cut_is_the_exact_one_of_each_strip_rounded_outwards(kind):
    """Mutants: a margin of the cut left out; the strip one unit narrower; a gain left out."""
    met = 0
    for given in cases(kind):
        if kind != "far":  # readings of a point of the set
            c, G, s, H, _, o, *_ = given
            xi = np.random.default_rng(3).uniform(-1, 1, M).round(3)
            given = (*given[:4], o + H @ (c + G @ xi), *given[5:])
        found = numeric(STEP, *given)
        c, G, s, *_ = map(exact, given)
        b, a, wide, _, low, high = (exact(v) for v in found[:6])
        for i in range(N):
            up, down = [c[i] + total(G)[i] + s[i]], [-c[i] + total(G)[i] + s[i]]
            for q in np.flatnonzero(given[-1]):
                if abs(b[q, 0]) <= total(a)[q] + wide[q, 0]:
                    up.append(farthest(c[i], G[i], s[i], a[q], b[q, 0], wide[q, 0]))
                    down.append(farthest(-c[i], -G[i], s[i], a[q], b[q, 0], wide[q, 0]))
            if len(up) == 1 + given[-1].sum():
                assert high[i, 0] >= min(up) and low[i, 0] <= -min(down)
                met += 1
                size = (np.abs(G[i]).sum() + abs(c[i])) * Q(1e-9) + Q(1e-280)
                if kind in ("plain", "cancelling"):
                    assert high[i, 0] <= min(up) + size and low[i, 0] >= -min(down) - size
    assert met > COUNT


def test_a_strip_that_touches_is_not_against():
    """Mutant: no margin, where the sum of many small generators is lost by rounding."""
    z = Zonotope(ca.SX(1, 1), ca.SX(ca.DM([[1.0, *[2.0**-54] * 40]])), ca.SX(1, 1))
    y = ca.SX.sym("y")
    strips = Strips(ca.SX(1), y, z.generators, ca.SX(0))
    against = ca.Function("f", [y], [strips.against])
    assert not against(1.0 + 40 * 2.0**-54) and against(1.0 + 2.0**-35)


@pytest.mark.parametrize("kind", KINDS)
def test_a_moved_zonotope_holds_the_exact_image(kind):
    """Mutants: the rounding of a centre or of a generator left out; the slack; the spread."""
    J, o, cols, spread, c, G, s = given = symbols((N, N), (N,), (N, 2), (N,), (N,), (N, M), (N,))
    z = moved(Zonotope(c, G, s), J, o, ca.horzsplit(cols), spread)
    function = ca.Function("f", given, [z.centre, z.generators, z.slack])
    rng = np.random.default_rng(1)
    for _ in range(COUNT):
        values = [
            numbers(rng, kind, *v.shape)[..., 0]
            if v.shape[1] == 1
            else numbers(rng, kind, *v.shape)
            for v in given
        ]
        zero = rng.random() < 0.3
        values[3], values[6] = np.abs(values[3]) * zero, np.abs(values[6]) * zero
        if kind == "far":
            values[0] = numbers(rng, "plain", N, N)
        centre, generators, slack = numeric(function, *values)
        J_, o_, _, spread_, c_, G_, s_ = map(exact, values)
        assert not slack.any() and np.array_equal(generators[:, :2], values[2])
        assert not (generators[:, 2 : 2 + N] - np.diag(np.diag(generators[:, 2:]))).any()
        lost = np.abs(J_ @ c_ + o_ - exact(centre)[:, 0]) + total(
            J_ @ G_ - exact(generators[:, 2 + N :])
        )
        assert (lost + np.abs(J_) @ s_ + spread_ <= exact(np.diag(generators[:, 2:]))).all()


@pytest.mark.parametrize("kind", [k for k in KINDS if k != "cancelling"])
def test_a_zonotope_of_a_box_holds_it(kind):
    """Mutants: the radius that the middle's rounding leaves; another middle, which is wider."""
    lower, upper = symbols((N,), (N,))
    z = Zonotope.of(Ends(lower, upper), M)
    function = ca.Function("f", [lower, upper], [z.centre, z.generators])
    rng = np.random.default_rng(2)
    for _ in range(COUNT):
        ends = np.sort(numbers(rng, kind, 2, N), axis=0)
        centre, generators = map(exact, numeric(function, *ends))
        reach = total(generators)
        assert generators.shape == (N, M) and (centre[:, 0] - reach <= exact(ends[0])).all()
        assert (centre[:, 0] + reach >= exact(ends[1])).all()
        half = (exact(ends[1]) - exact(ends[0])) / 2
        assert (reach <= half + np.abs(exact(ends)).max(axis=0) * Q(1e-11) + Q(1e-289)).all()


def inverted(B):
    """The exact inverse of a matrix of rationals, by elimination."""
    n = len(B)
    rows = np.hstack([B, exact(np.eye(n))])
    for k in range(n):
        pivot = k + int(np.argmax(np.abs(rows[k:, k])))
        rows[[k, pivot]] = rows[[pivot, k]]
        rows[k] = rows[k] / rows[k, k]
        for i in set(range(n)) - {k}:
            rows[i] = rows[i] - rows[i, k] * rows[k]
    return rows[:, n:]


def basis(rng, condition):
    """A basis of a condition, its rows in units of very different sizes."""
    left, right = (np.linalg.qr(rng.normal(size=(N, N)))[0] for _ in range(2))
    sizes = condition ** -np.array([0.0, 0.5, 1.0])
    return 10.0 ** rng.uniform(-6, 6, (N, 1)) * ((left * sizes) @ right)


def nearly_parallel(k):
    """Integers with an inverse of integers; the last two columns differ by ones."""
    return np.array([[1.0, k, k], [0.0, k, k + 1.0], [0.0, k - 1.0, k]])


BASES = {
    "integers": lambda rng: nearly_parallel(float(rng.integers(500, 2000))),
    "states": lambda rng: np.diag(10.0 ** rng.uniform(-6, 6, N)),
    "modes": lambda rng: basis(rng, 10.0),
    "rough": lambda rng: basis(rng, 10.0),
    "dependent": lambda rng: basis(rng, 1e8),
}


@pytest.mark.parametrize("kind", ["plain", "wide", "tiny", "far"])
@pytest.mark.parametrize("base", BASES)
def test_dropped_columns_lie_in_the_box_that_takes_their_place(base, kind):
    """Exactly: ``|B^-1 D| 1 + |B^-1| slack <= 1`` for the columns B that are returned.

    Mutants: the rounding of W D, of V diag(reach), left out; the leak; the size of the slack.
    """
    c, G, s = symbols((N,), (N, M), (N,))
    rng, keep = np.random.default_rng(4), 2
    for _ in range(4):
        V = BASES[base](rng)
        held = frame(V)
        if base == "rough":
            W = held.W * (1.0 + 1e-7 * rng.uniform(-1, 1, (N, N)))
            off = off_identity(V, W)
            size = product_up(np.abs(W), np.eye(N) + 2.0 * off)
            held = Frame(V, W, size, product_up(size, off))
        if base == "integers":  # an exact inverse: nothing leaks
            W = np.round(held.W)
            held = Frame(V, W, np.abs(W), np.zeros((N, N)))
        z = reduced(Zonotope(c, G, s), keep, held)
        function = ca.Function("f", [c, G, s], [z.centre, z.generators, z.slack])
        for turn in range(8):
            values = [
                numbers(rng, kind, N),
                numbers(rng, kind, N, M),
                np.abs(numbers(rng, kind, N)),
            ]
            if kind == "plain" and turn % 2:  # nothing along one coordinate, but for rounding
                own = V @ np.array([0.0, 1.0, -1.0]) if base == "integers" else V[:, turn % N]
                values[1] = own[:, None] * values[1][:1]
            values[2] *= rng.random() < 0.3
            centre, generators, slack = numeric(function, *values)
            assert np.array_equal(centre[:, 0], values[0]) and not slack.any()
            assert np.array_equal(generators[:, N:], values[1][:, :keep])
            B = inverted(exact(generators[:, :N]))
            reach = total(B @ exact(values[1][:, keep:])) + np.abs(B) @ exact(values[2])
            assert (reach <= 1).all(), float(max(reach) - 1)
