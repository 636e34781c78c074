"""Branch and bound for the largest eigenvalue of a symmetric matrix function over a box.

A box is bounded in two ways. First by the interval matrix of its entries: sign matrices of Hertz
where there are few, else centre plus norm of the radius. This loses in the first order of the
width. Second by an expansion about a point x* of the box, in the basis Q of the eigenvectors there:
Q'SQ = diag(w) + sum_j d_j G_j with G_j = Q' (dS/dx_j) Q enclosed over the box. With the r largest
eigenvalues in one block, mu a bound of the largest eigenvalue of the other block over the box, and
any t > mu, the largest eigenvalue is at most

    max(t, w_1 + largest eigenvalue of sum_j d_j G_j^11 + |sum_j d_j G_j^21|^2 / (t - mu)),

the Schur complement of t I - Q'SQ. The last term is of second order, so that a box whose best point
is the corner x* closes as soon as the slope of the eigenvalue there beats it: no cluster of small
boxes is left at a corner. t is the value attained so far, below which no bound is needed.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from obsynth.derive.constants.symmetric_field import (
    FieldRange,
    SymmetricField,
    eigenvalue_over_interval,
)
from obsynth.derive.intervals.ranges import Status
from obsynth.derive.intervals.search.batch import Rows
from obsynth.derive.rigour import (
    UNIT_ROUNDOFF,
    down,
    finite,
    largest_eigenvalue,
    rotate,
    up,
)
from obsynth.symbolic.arrays import FloatArray

EIGENVALUE_BUDGETS = {"fast": 500, "normal": 20_000, "tight": 400_000}
_MOST_NUMBERS = 2_000_000
_FEW_SIGNS = 3
_SAMPLES = 64
_ROUNDS = 32
# An eigenvalue near zero is wanted to this share of the largest one only.
_SMALL = 1e-3


@dataclass(frozen=True, eq=False)
class Maximum:
    """A largest value over a box: guaranteed from above, attained from below.

    at: the point of the attained value, by symbol; symbols that do not matter are left out
    method: where the upper bound comes from
    """

    upper: float
    attained: float
    at: dict[str, float]
    status: Status
    method: str
    boxes: int = 0

    @property
    def gap(self) -> float:
        """Guaranteed minus attained value."""
        return self.upper - self.attained

    @property
    def where(self) -> str:
        """The point as text."""
        return ", ".join(f"{name} = {value:.6g}" for name, value in self.at.items())

    def __float__(self) -> float:
        return self.upper

    def __str__(self) -> str:
        text = f"{self.upper:.8g} ({self.status.word}, gap {self.gap:.1e}; {self.method})"
        return f"{text} at {self.where}" if self.at else text


@dataclass(frozen=True, eq=False)
class _Expansion:
    """Second-order bound of a batch of boxes, and what it learnt."""

    bound: FloatArray
    attained: FloatArray
    anchor: FloatArray
    loss: FloatArray


def _anchor(boxes: Rows, found: FieldRange) -> FloatArray:
    """Pick the point where the top eigenvalue seems largest: a corner where slopes have a sign."""
    top = np.linalg.eigh(np.where(np.isfinite(found.centre), found.centre, 0.0))[1][:, :, -1]
    slope = np.einsum("na,nvab,nb->vn", top, found.slope_centre, top)
    doubt = np.einsum("na,nvab,nb->vn", np.abs(top), found.slope_radius, np.abs(top))
    middle = np.clip(0.5 * (boxes.lower + boxes.upper), boxes.lower, boxes.upper)
    return np.where(slope >= doubt, boxes.upper, np.where(-slope >= doubt, boxes.lower, middle))


def expansion_bound(
    field: SymmetricField, boxes: Rows, found: FieldRange, best: float
) -> _Expansion:
    """Bound the largest eigenvalue by the Schur complement, see the head of this module."""
    anchor = _anchor(boxes, found)
    centre, radius = field.over(anchor, anchor)
    turned = rotate(centre, radius)
    attained = turned.lower(down(turned.values[:, -1] - turned.error))
    k, size = field.size, np.abs(turned.vectors)
    across, back = turned.vectors.transpose(0, 2, 1)[:, None], turned.vectors[:, None]
    slopes = across @ found.slope_centre @ back
    spread = found.slope_radius + 1.01 * (2 * k + 6) * UNIT_ROUNDOFF * np.abs(found.slope_centre)
    doubt = np.swapaxes(size, 1, 2)[:, None] @ spread @ size[:, None] * (1.0 + 1e-14)
    rise = np.where(boxes.upper > anchor, up(boxes.upper - anchor), 0.0).T
    fall = np.where(anchor > boxes.lower, up(anchor - boxes.lower), 0.0).T
    reach = np.maximum(rise, fall)
    bound = np.full(len(anchor.T), np.inf)
    loss = reach * (np.abs(slopes) + doubt).max(axis=(2, 3))
    blocks = sorted({1, 2, k} & set(range(1, k + 1)))
    with np.errstate(all="ignore"):
        for r in blocks:
            inner, outer = slice(k - r, k), slice(0, k - r)
            if r == 1:
                ahead = slopes[:, :, -1, -1] + doubt[:, :, -1, -1]
                behind = -slopes[:, :, -1, -1] + doubt[:, :, -1, -1]
            else:
                ahead = _top(slopes[:, :, inner, inner], doubt[:, :, inner, inner])
                behind = _top(-slopes[:, :, inner, inner], doubt[:, :, inner, inner])
            coupling = np.zeros_like(reach)
            price = np.zeros(len(bound))
            apart = np.ones(len(bound), dtype=bool)
            if r < k:
                block = np.abs(slopes[:, :, outer, inner]) + doubt[:, :, outer, inner]
                coupling = np.sqrt((block**2).sum(axis=(2, 3))) * (1.0 + 1e-14)
                rest = np.abs(slopes[:, :, outer, outer]) + doubt[:, :, outer, outer]
                move = (reach * rest.sum(axis=3).max(axis=2)).sum(axis=1)
                mu = turned.values[:, k - r - 1] + move * (1.0 + 1e-13)
                room = best - mu - 1e-12 * (np.abs(best) + np.abs(mu))
                total = (reach * coupling).sum(axis=1)
                apart = room > 0.0
                price = np.where(apart, total / room, np.inf) * (1.0 + 1e-13)
            push = np.where(coupling > 0.0, price[:, None] * coupling, 0.0)
            excess = np.maximum(np.maximum(rise * (ahead + push), fall * (behind + push)), 0.0)
            value = turned.values[:, -1] + excess.sum(axis=1) * (1.0 + 1e-13)
            value = np.maximum(value, best) + turned.error
            value = turned.upper(value + 4.0 * UNIT_ROUNDOFF * np.abs(value))
            better = np.asarray(apart & (value < bound), dtype=np.bool_)
            bound = np.where(better, value, bound)
            loss = np.where(better[:, None], excess, loss)
    bound = np.where(found.smooth & ~np.isnan(bound), bound, np.inf)
    return _Expansion(bound, attained, anchor, np.where(np.isfinite(loss), loss, np.inf))


def _top(slopes: FloatArray, doubt: FloatArray) -> FloatArray:
    n, v, r = slopes.shape[:3]
    symmetric = 0.5 * (slopes + np.swapaxes(slopes, 2, 3))
    wide = np.maximum(doubt, np.swapaxes(doubt, 2, 3)) + np.abs(symmetric - slopes)
    upper = largest_eigenvalue(symmetric.reshape(-1, r, r), wide.reshape(-1, r, r))[1]
    return upper.reshape(n, v)


def largest_over_box(
    field: SymmetricField,
    names: Sequence[str],
    known: float = np.inf,
    known_method: str = "",
    pieces: Sequence[tuple[Sequence[int], FloatArray]] = (),
    level: float = -np.inf,
    rtol: float = 1e-6,
    effort: str = "normal",
) -> Maximum:
    """Bound the largest eigenvalue of a symmetric matrix function over its box."""
    low, high = field.problem.lower, field.problem.upper
    best, where, scale = _sample(field, pieces)
    bounded = bool(np.isfinite(low).all() and np.isfinite(high).all())
    tolerance = rtol * max(abs(best), _SMALL * scale, 1e-300)
    relevant = np.asarray(field.problem.relevant.any(axis=0), dtype=np.bool_)
    bound, count = known, 0
    if not ((high > low) & relevant).any():
        bound = float(largest_eigenvalue(*field.over(where[:, None], where[:, None]))[1][0])
        known_method = "the one matrix there is"
    if bound > max(best, level) + tolerance and bounded:
        found, best, where, count = _search(
            field, best, where, level, tolerance, EIGENVALUE_BUDGETS[effort]
        )
        if found < known:
            bound, known_method = found, "branch and bound over the box"
    status = Status.BUDGET
    reached = max(best, level)
    if bound - reached <= max(64.0 * UNIT_ROUNDOFF * field.size * scale, 1e-300):
        status = Status.EXACT
    elif bound - reached <= tolerance:
        status = Status.CONVERGED
    at = {name: float(where[k]) for k, name in enumerate(names) if relevant[k]}
    return Maximum(float(bound), float(best), at, status, known_method, count)


def _sample(
    field: SymmetricField, pieces: Sequence[tuple[Sequence[int], FloatArray]]
) -> tuple[float, FloatArray, float]:
    """Best value over the middle, corners and random points; scale of the values.

    The best point is then improved by the pieces, one after the other while that helps.
    """
    low, high = field.problem.lower, field.problem.upper
    start = np.where(np.isfinite(low), low, np.where(np.isfinite(high), high - 2.0, -1.0))
    width = np.where(np.isfinite(high), high, start + 2.0) - start
    rng = np.random.default_rng(0)
    share = np.vstack(
        [
            np.full(len(low), 0.5),
            rng.random((_SAMPLES, len(low))),
            rng.integers(0, 2, (_SAMPLES, len(low))),
        ]
    )
    tried = np.clip(start + share * width, start, start + width)
    value, modulus = _values(field, tried)
    k = int(np.argmax(value))
    best, where, scale = float(value[k]), tried[k], float(modulus.max(initial=0.0))
    for _ in range(_ROUNDS if pieces else 0):
        tried = np.tile(where, (len(pieces), 1))
        for row, (index, values) in zip(tried, pieces, strict=True):
            row[list(index)] = values
        value, modulus = _values(field, np.clip(tried, low, high))
        k, scale = int(np.argmax(value)), max(scale, float(modulus.max(initial=0.0)))
        if value[k] <= best:
            break
        best, where = float(value[k]), np.clip(tried[k], low, high)
    return best, where, scale


def _values(field: SymmetricField, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Attained largest eigenvalues, and the moduli of all eigenvalues."""
    centre, radius = field.over(points.T, points.T)
    usable = finite(radius)
    value = np.where(usable, largest_eigenvalue(centre, radius)[0], -np.inf)
    return value, np.abs(np.linalg.eigvalsh(np.where(usable[:, None, None], centre, 0.0)))


def _search(
    field: SymmetricField,
    best: float,
    where: FloatArray,
    level: float,
    tolerance: float,
    budget: int,
) -> tuple[float, float, FloatArray, int]:
    v = max(field.variables, 1)
    chunk = max(8, min(1024, _MOST_NUMBERS // (v * field.size**2)))
    low, high = field.problem.lower, field.problem.upper
    span = np.where(high > low, high - low, 1.0)[:, None]
    boxes = Rows(np.zeros(1, np.int64), low[:, None], high[:, None], np.array([np.inf]))
    closed, count = best, 0
    attained, best = best, max(best, level)
    while boxes.bound.size and count < budget:
        order = np.asarray(np.argsort(-boxes.bound, kind="stable"), dtype=np.int64)
        now, later = boxes.take(order[:chunk]), boxes.take(order[chunk:])
        count += len(now.bound)
        found = field.with_slopes(now.lower, now.upper)
        grown = expansion_bound(field, now, found, best)
        k = int(np.argmax(grown.attained))
        if grown.attained[k] > attained:
            attained, where = float(grown.attained[k]), grown.anchor[:, k]
            best = max(best, attained)
        bound = np.minimum(now.bound, grown.bound)
        hard = bound > best + tolerance
        plain, _ = eigenvalue_over_interval(found.centre[hard], found.radius[hard], _FEW_SIGNS)
        bound[hard] = np.minimum(bound[hard], plain)
        width = now.upper - now.lower
        done = (bound <= best + tolerance) | (width <= 0.0).all(axis=0)
        closed = max(closed, float(bound[done].max(initial=-np.inf)))
        rest = ~done
        score = np.where(np.isfinite(grown.loss.T) & (bound < np.inf), grown.loss.T, width / span)
        score = np.where(score.max(axis=0) > 0.0, score, width / span)[:, rest]
        axis = np.argmax(np.where(width[:, rest] > 0.0, score, -1.0), axis=0)
        boxes = later.join(replace(now, bound=bound).take(rest).halves(axis))
        settled = boxes.bound <= best + tolerance
        closed = max(closed, float(boxes.bound[settled].max(initial=-np.inf)))
        boxes = boxes.take(~settled)
    return max(closed, float(boxes.bound.max(initial=-np.inf))), attained, where, count
