"""Guaranteed bounds as largest and smallest of finitely many linear functions.

upper = max_i U_i s, lower = min_i L_i s, with s a stack of what is known at run time (bounds of r,
the measurement, the input, 1), exact; `Rows.slack` says by how much to widen in floating point.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.derive.rigour import UNIT, Exact, above, exact, image, magnitude, negative, positive
from obsynth.designs.core.record import Precision
from obsynth.designs.core.stepping import slices
from obsynth.designs.interval.decoupling import Decoupled
from obsynth.designs.interval.model import IntervalModel
from obsynth.symbolic.arrays import FloatArray

SMALLEST: Mapping[Precision, float] = {"double": 2.0**-1000, "single": 2.0**-120}
"""Above what many underflows of a sum can cost."""


@dataclass(frozen=True, eq=False)
class Rows:
    """upper = max_i U_i s, lower = min_i L_i s; sizes: of the parts of s; radius: off by |s|."""

    sizes: Mapping[str, int]
    upper: tuple[Exact, ...]
    lower: tuple[Exact, ...]
    radius: Exact

    @property
    def count(self) -> int:
        """Number of rows."""
        return int(self.radius.shape[0])

    @property
    def places(self) -> dict[str, slice]:
        """Where the parts of s stand."""
        return slices(self.sizes)

    def slack(self, precision: Precision) -> FloatArray:
        """Coefficients of |s| by which a bound is widened at run time, shape (rows, len(s)).

        (t + 3) u for a sum of t products, and three units more for the widening itself and terms of
        second order, for t up to about a thousand.
        """
        unit = UNIT[precision]
        every = np.stack([*self.upper, *self.lower])
        largest = np.abs(every).max(axis=0)
        terms = (every != 0).sum(axis=2).max(axis=0)
        counts = exact(np.asarray(terms + 6, dtype=float))[:, None]
        table = above(largest * counts * exact(unit) + self.radius)
        table[:, self.places["one"]] += SMALLEST[precision]
        return table * (1.0 + 2.0**-50)


def _stack(sizes: Mapping[str, int], count: int, parts: Mapping[str, Any]) -> Exact:
    """Put named blocks side by side; a missing block is zero."""
    blocks = []
    for name, size in sizes.items():
        block = exact(np.zeros((count, size)))
        if name in parts:
            block[:] = np.asarray(parts[name], dtype=object).reshape(count, size)
        blocks.append(block)
    return np.hstack(blocks)


@dataclass(frozen=True, eq=False)
class Part:
    """The quantity X (A x + B u + o + W1 w) + Y (N12 (y - W2 w) - C2 z2) of one instant, z2 = S r.

    With X = P T2 and Y = P L it is r of the next instant, with X = -F_left and Y = 0 the share of
    the fault that is known one instant before the rest.
    """

    model: IntervalModel
    decoupled: Decoupled
    S: Exact
    X: Exact
    Y: Exact

    def on_r(self, A: Exact) -> Exact:
        """Return the coefficients of r for a matrix A."""
        value: Exact = (self.X @ A @ self.decoupled.W - self.Y @ self.decoupled.C2) @ self.S
        return value

    def on_y(self, A: Exact) -> Exact:
        """Return the coefficients of y for a matrix A."""
        value: Exact = self.X @ A @ self.decoupled.Phi + self.Y @ self.decoupled.N12
        return value

    def on_w(self, A: Exact) -> Exact:
        """Return the coefficients of w for a matrix A."""
        value: Exact = self.X @ self.model.W1 - self.on_y(A) @ self.model.W2
        return value

    @property
    def radius(self) -> tuple[Exact, Exact, Exact, Exact]:
        """What rounding in the family may add to the coefficients of r, y, u and 1."""
        a, b, o = self.model.columns
        rho = exact(self.model.family.radius)
        X = magnitude(self.X)
        r = X @ rho[:, a] @ magnitude(self.decoupled.W @ self.S)
        y = X @ rho[:, a] @ magnitude(self.decoupled.Phi)
        noise = y @ magnitude(self.model.W2) @ self.model.size("w")
        return r, y, X @ rho[:, b], X @ rho[:, o] + noise[:, None]

    @property
    def size(self) -> Exact:
        """Largest magnitude of X (A x + B u + o + W1 w) over the declared boxes."""
        model = self.model
        signals = np.concatenate([model.size("x"), model.size("u"), exact(np.ones(1))])
        driven = magnitude(self.X @ model.W1) @ model.size("w")
        rows = [magnitude(self.X @ vertex) @ signals for vertex in model.vertices]
        largest: Exact = np.stack(rows).max(axis=0) + driven
        return largest

    def vertex_rows(self) -> Rows:
        """Bound at the vertices of the polytope: one vertex for y, w and r together."""
        a, b, o = self.model.columns
        low, high = self.model.box("w").T
        sizes = _sizes(self, ("r_upper", "r_lower", "y", "u", "one"))
        count = len(self.X)
        upper, lower = [], []
        for vertex in self.model.vertices:
            M, N = self.on_r(vertex[:, a]), self.on_y(vertex[:, a])
            least, largest = image(self.on_w(vertex[:, a]), low, high)
            rest = self.X @ vertex[:, o]
            known = {"y": N, "u": self.X @ vertex[:, b]}
            up, down = _both_ends("r", M)
            upper.append(_stack(sizes, count, {**known, **up, "one": rest + largest[:, None]}))
            lower.append(_stack(sizes, count, {**known, **down, "one": rest + least[:, None]}))
        r, y, u, one = self.radius
        radius = {"r_upper": r, "r_lower": r, "y": y, "u": u, "one": one}
        return Rows(sizes, tuple(upper), tuple(lower), _stack(sizes, count, radius))

    def split(self, nominal: Exact) -> Remainder:
        """Return nominal coefficients and elementwise bounds of what varies around them."""
        return Remainder.of(self, nominal)

    def paper_rows(self, nominal: Exact) -> Rows:
        """Bound of (13)-(15) and (32), term by term; input matrix and offset constant."""
        _, b, o = self.model.columns
        names = ("r_upper+", "r_upper-", "r_lower+", "r_lower-", "r_upper", "r_lower")
        sizes = _sizes(self, (*names, "y+", "y-", "u", "one"))
        count, parts = len(self.X), self.split(nominal)
        R, constant = parts.R, self.model.vertices[0]
        rest, known = self.X @ constant[:, o], {"u": self.X @ constant[:, b]}
        sigma, M = (parts.sigma_lower, parts.sigma_upper), (parts.M_lower, parts.M_upper)

        def end(own: int) -> dict[str, Exact]:
            this, other = (("r_lower", "r_upper")[k] for k in (own, 1 - own))
            return {
                f"{this}+": positive(sigma[own]),
                f"{this}-": -positive(sigma[1 - own]),
                f"{other}+": -negative(sigma[own]),
                f"{other}-": negative(sigma[1 - own]),
                this: positive(R),
                other: -negative(R),
                "y+": M[own],
                "y-": -M[1 - own],
                "one": rest + parts.noise[own][:, None],
                **known,
            }

        r, y, u, one = self.radius
        radius = {"r_upper": r, "r_lower": r, "y+": y, "y-": y, "u": u, "one": one}
        return Rows(
            sizes,
            (_stack(sizes, count, end(1)),),
            (_stack(sizes, count, end(0)),),
            _stack(sizes, count, radius),
        )


@dataclass(frozen=True, eq=False)
class Remainder:
    """Nominal coefficients of a `Part`, bounds of what varies, (14)-(15), and a box of noise."""

    R: Exact
    sigma_lower: Exact
    sigma_upper: Exact
    M_lower: Exact
    M_upper: Exact
    noise: tuple[Exact, Exact]

    @classmethod
    def of(cls, part: Part, nominal: Exact) -> Remainder:
        """Bound every coefficient apart over the elementwise box of A - nominal."""
        a, _, _ = part.model.columns
        around = np.stack([vertex[:, a] - nominal for vertex in part.model.vertices])
        low, high = around.min(axis=0), around.max(axis=0)
        sigma = _image(part.X, low, high, part.decoupled.W @ part.S)
        change = _image(part.X, low, high, part.decoupled.Phi)
        M = part.on_y(nominal)
        M_lower, M_upper = M + change[0], M + change[1]
        w_low, w_high = part.model.box("w").T
        v_low, v_high = image(part.model.W2, w_low, w_high)
        products = [m * v for m in (M_lower, M_upper) for v in (v_low, v_high)]
        stacked = np.stack(products) if products[0].size else np.zeros((1, *M.shape), dtype=object)
        own = image(part.X @ part.model.W1, w_low, w_high)
        noise = (
            own[0] - stacked.max(axis=0).sum(axis=1),
            own[1] - stacked.min(axis=0).sum(axis=1),
        )
        return cls(part.on_r(nominal), *sigma, M_lower, M_upper, noise)


def _image(left: Exact, low: Exact, high: Exact, right: Exact) -> tuple[Exact, Exact]:
    """Return elementwise bounds of left D right over low <= D <= high, every entry bounded once."""
    rows, columns = left.shape[0], right.shape[1]
    lower, upper = exact(np.zeros((2, rows, columns)))
    for i, j in np.ndindex(rows, columns):
        weights = np.outer(left[i], right[:, j])
        plus, minus = positive(weights), negative(weights)
        lower[i, j] = lower[i, j] + (plus * low - minus * high).sum()
        upper[i, j] = upper[i, j] + (plus * high - minus * low).sum()
    return lower, upper


def _sizes(part: Part, names: tuple[str, ...]) -> dict[str, int]:
    n2, m, n_u = len(part.S), len(part.model.C), len(part.model.plant.u)
    known = {"y": m, "u": n_u, "one": 1}
    return {name: known.get(name.rstrip("+-"), n2) for name in names}


def _both_ends(name: str, M: Exact) -> tuple[dict[str, Exact], dict[str, Exact]]:
    """Return what the ends of a vector add to the upper and the lower end of M times it."""
    up = {f"{name}_upper": positive(M), f"{name}_lower": -negative(M)}
    return up, {f"{name}_lower": positive(M), f"{name}_upper": -negative(M)}


def _linear(
    sizes: Mapping[str, int],
    r: Exact,
    y: Exact,
    noise: tuple[Exact, Exact],
    more: Mapping[str, Any],
) -> Rows:
    """One linear function of r and y with a box of noise."""
    count = len(r)
    up, down = _both_ends("r", r)
    own = {"y": y, "one": noise[1][:, None]}, {"y": y, "one": noise[0][:, None]}
    upper = {**up, **own[0], **{k: v for k, v in more.items() if k.endswith("upper")}}
    lower = {**down, **own[1], **{k: v for k, v in more.items() if k.endswith("lower")}}
    nothing = _stack(sizes, count, {})
    return Rows(sizes, (_stack(sizes, count, upper),), (_stack(sizes, count, lower),), nothing)


def state_rows(part: Part) -> Rows:
    """Bounds of x from r and y of the same instant, (26)."""
    low, high = part.model.box("w").T
    noise = image(-part.decoupled.Phi @ part.model.W2, low, high)
    sizes = _sizes(part, ("r_upper", "r_lower", "y", "one"))
    return _linear(sizes, part.decoupled.W @ part.S, part.decoupled.Phi, noise, {})


def estimate_rows(part: Part, faults: int) -> Rows:
    """Bounds of the first faults from their earlier share and r and y of the next instant, (32)."""
    left = part.decoupled.F_left[:faults]
    low, high = part.model.box("w").T
    noise = image(-left @ part.decoupled.Phi @ part.model.W2, low, high)
    sizes = {
        "share_upper": faults,
        "share_lower": faults,
        **_sizes(part, ("r_upper", "r_lower", "y", "one")),
    }
    same = exact(np.eye(faults))
    more = {"share_upper": same, "share_lower": same}
    return _linear(sizes, left @ part.decoupled.W @ part.S, left @ part.decoupled.Phi, noise, more)


def first_rows(r: Exact) -> Rows:
    """Bounds of r x for a box of states x."""
    sizes = {"x_upper": r.shape[1], "x_lower": r.shape[1], "one": 1}
    up, down = _both_ends("x", r)
    upper, lower, nothing = (_stack(sizes, len(r), parts) for parts in (up, down, {}))
    return Rows(sizes, (upper,), (lower,), nothing)


def measured_rows(part: Part, output: int, component: int) -> Rows:
    """Bounds of one component of r from one row of N12 y = C2 S r + N12 W2 w."""
    Q = part.decoupled.C2 @ part.S
    row = part.decoupled.N12[output : output + 1] / Q[output, component]
    others = -Q[output : output + 1] / Q[output, component]
    others[0, component] = exact(0.0).item()
    low, high = part.model.box("w").T
    noise = image(-row @ part.model.W2, low, high)
    return _linear(_sizes(part, ("r_upper", "r_lower", "y", "one")), others, row, noise, {})
