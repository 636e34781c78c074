"""The mean of every fault over the last m instants, for any course of the fault.

docs/step.md, Means of faults over a window. D of a relation is simplified as text before it is
enclosed: what x, f and ``c'F`` have in common is gone. Every operation is rounded outwards, and
sums are formed anew at every call from what is remembered of m-1 instants.
"""

from functools import cached_property, reduce
from itertools import combinations
from typing import Any

import casadi as ca
import numpy as np
import sympy as sp

from obsynth.derive.rigour.interval import rational
from obsynth.designs.core.boxes import Ends, Lifted, Rounding
from obsynth.designs.core.equations import Before, Equations
from obsynth.designs.core.lifted import combine
from obsynth.designs.core.observer import MEAN_OUTPUTS, STATUS, STEP_OUTPUTS
from obsynth.designs.core.stepping import counter, inside, slices
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.convert import to_sx

MOST = 3
"""Relations that are kept for a fault, the narrowest."""
LONGEST = 100
"""How often a state may enter a row of a step of higher order, about, to be written out."""
_UNKNOWN = 1e9  # half width of a state of which nothing is known beforehand
_JOINED = tuple(name for name in STATUS if name != "fault_not_valid")
_CHUNK = 512


def relations(
    plant: Plant, half_widths: FloatArray | None, m: int
) -> tuple[list[int], Equations | None]:
    """Return the faults of the relations that should be narrowest over m instants, and their rows.

    half_widths (n + n_f,): to be expected, ranges by default; rows: D of all relations, then P
    """
    n, n_f, hidden = len(plant.x), len(plant.f), [s for s in plant.rho if not s.measured]
    unknown = (*plant.x, *plant.f, *plant.d, *plant.w, *plant.p, *hidden)
    known = (*plant.u, *(s for s in plant.rho if s.measured))
    ports = [ca.SX.sym("v", len(unknown)), ca.SX.sym("known", len(known))]
    symbols = [s.symbol for s in (*unknown, *known)]
    places = dict(zip(symbols, ca.vertsplit(ca.vertcat(*ports)), strict=True))
    sizes = np.array([0.5 * (s.upper - s.lower) for s in unknown])
    if half_widths is not None:
        sizes[: n + n_f] = np.minimum(sizes[: n + n_f], half_widths)
    sizes[:n] = np.minimum(sizes[:n], _UNKNOWN)
    at = dict.fromkeys(symbols, 0.0)
    for s in (*plant.x, *unknown[n + n_f :], *known):
        middle = 0.5 * (s.lower + s.upper) if s.bounded else 0.0
        at[s.symbol] = middle if s.nominal is None else float(s.nominal)
    numbers = np.split([at[s] for s in symbols], [len(unknown)])
    found = []
    pairs = _combined(plant) if _is_short(plant) else []
    for j, (cx, row) in [(j, pair) for j in range(n_f) for pair in pairs]:
        fault = plant.f[j].symbol
        slope = sp.diff(row, fault)
        if not slope.is_number:
            value = float(slope.subs(at)) if slope.subs(at).is_real else np.inf
            slope = rational(value) if np.isfinite(value) else sp.S.Zero
        if slope == 0:
            continue
        pair = _spread(row - cx, 1 / slope) - fault, _spread(cx, 1 / slope)
        code = ca.vertcat(*to_sx(pair, places, [f"the mean of {fault}"] * 2))
        J = ca.Function("J", ports, [ca.densify(ca.jacobian(code, ports[0]))])
        slopes = np.abs(np.array(J(*numbers)))
        wide = (slopes * np.where(slopes == 0.0, 0.0, sizes)).sum(axis=1) @ [1.0, 2.0 / m]
        if np.isfinite(wide):
            found.append((float(wide), j, code))
    found.sort(key=lambda entry: entry[0])
    kept = [e for j in range(n_f) for e in [one for one in found if one[1] == j][:MOST]]
    if not kept:
        return [], None
    rows = ca.vertcat(*(code[side] for side in (0, 1) for _, _, code in kept))
    return [j for _, j, _ in kept], Equations(plant, ca.Function("relations", ports, [rows]))


def _is_short(plant: Plant) -> bool:
    """Whether the rows can be written out: those of a step of order k grow with the power k - 1."""
    if plant.step is None or plant.continuous is None:
        return True
    x, rows = {s.symbol for s in plant.x}, plant.continuous.equations[0]
    most = max(sum(node in x for node in sp.preorder_traversal(row)) for row in rows)
    return bool(most ** (plant.step.order - 1) <= LONGEST)


def _combined(plant: Plant) -> list[tuple[sp.Expr, sp.Expr]]:
    """Return c'x and c'F of every row, and of pairs without a term that they share."""
    x, rows = [s.symbol for s in plant.x], []
    for row in plant.rhs:
        exact = row.xreplace(plant.constant_values)
        rows.append(_spread(exact.xreplace({a: rational(float(a)) for a in exact.atoms(sp.Float)})))
    found = list(zip(x, rows, strict=True))
    terms = [row.as_coefficients_dict() for row in rows]
    for i, k in combinations(range(len(x)), 2):
        a, b = terms[i], terms[k]
        shares = dict.fromkeys(-a[t] / b[t] for t in list(a) if t in b)
        found += [(x[i] + s * x[k], rows[i] + _spread(rows[k], s)) for s in shares]
    return found


def _spread(expression: sp.Expr, factor: sp.Expr = sp.S.One) -> sp.Expr:
    """Multiply a sum with a number, term by term."""
    number, rest = expression.as_coeff_Mul()
    if not rest.is_Add:
        return factor * expression
    return sp.Add(*(_spread(term, factor * number) for term in rest.args))


class Window:
    """The recursion of the means behind an observer's step; of the F_j alone with an ode."""

    def __init__(self, observer: Any, m: int) -> None:
        self.m, self.plant, self.delay = m, observer.model, observer.fault_delay
        self.precision = observer.precision
        self.relations: tuple[list[int], Equations | None] = [], None
        if observer.ode is None:
            self.relations = relations(self.plant, observer.half_widths, m)
        n, n_f, q = len(self.plant.x), len(self.plant.f), len(self.relations[0])
        n_theta = sum(s.measured for s in self.plant.rho) * (observer.step.n_in() > 3)
        named = dict(zip(STEP_OUTPUTS[3:], (n, n, n_f, n_f, 1), strict=True))
        self.sizes = {"u": len(self.plant.u), "theta": n_theta, **named}
        kept = {"count": 1, "ready": 1, "since": len(_JOINED), "x": 2 * n, "f": 2 * n_f}
        kept |= {"known": len(self.plant.u) + n_theta, "parts": 2 * (m - 1) * (n_f + 2 * q)}
        self.layout = slices({f"mean_{name}": size for name, size in kept.items() if size})
        self.first: FloatArray = np.zeros(sum(kept.values()))
        self.first[self.layout["mean_since"]] = m + 1.0

    @cached_property
    def step(self) -> ca.Function:
        """(memory, u, theta, x_lower, ..., f_upper, status) -> (memory, *MEAN_OUTPUTS)."""
        found, equations = self.relations
        memory = ca.SX.sym("memory", len(self.first))
        ports = [ca.SX.sym(name, size) for name, size in self.sizes.items()]
        u, theta, x_lower, x_upper, f_lower, f_upper, status = ports
        part = dict.fromkeys(("known", "parts"), ca.SX(0, 1))
        part |= {name[5:]: memory[place] for name, place in self.layout.items()}
        bit = {k: ca.fmod(ca.floor(status / value), 2) >= 1 for k, value in STATUS.items()}
        good = ca.logic_not(ca.logic_or(bit["not_initialised"], bit["void"]))
        declared = Ends.of(self.plant.box("f").reshape(-1, 2), self.precision)
        F = declared.where(bit["fault_not_valid"], declared.meet(Ends(f_lower, f_upper)))
        earlier = F if self.delay else _unpacked(part["f"])
        X, known, usable, now = Ends(x_lower, x_upper), ca.vertcat(u, theta), good, []
        row: list[Any] = [earlier]
        if equations is not None:
            X = X.meet(Ends.of(equations.box[: equations.n], self.precision))
            then = Before(_unpacked(part["x"]), earlier, part["known"])
            r, q = Rounding(self.precision), len(found)
            row += [equations.image(i, then, r) for i in range(2 * q)]
            now = [equations.image(q + i, Before(X, F, known), r) for i in range(q)]
            covered = inside(known, known, equations.known_box, self.precision)
            usable = ca.logic_and(usable, covered)
        newest = ca.vertcat(*(e.lower for e in row), *(e.upper for e in row))
        parts = ca.vertcat(newest, part["parts"])
        going = ca.logic_and(good, part["ready"] > 0.5)
        count = ca.if_else(going, ca.fmin(counter(part["count"], self.m) + 1, self.m), 0)
        full = count > self.m - 0.5
        mean = declared.meet(self._mean(parts, now))
        void = ca.logic_and(full, mean.empty())
        mean = mean.where(ca.logic_and(full, ca.logic_not(void)), declared)
        word, since = STATUS["fault_not_valid"] * ca.logic_not(full), []
        for i, name in enumerate(_JOINED):
            age = ca.fmin(counter(part["since"][i], self.m + 1) + 1, self.m + 1)
            since.append(ca.if_else(bit[name], 0, age))
            flag = since[i] < self.m + 0.5
            word += STATUS[name] * (ca.logic_or(flag, void) if name == "void" else flag)
        moved = {"count": ca.if_else(void, 0, count), "ready": usable, "since": ca.vertcat(*since)}
        kept = [ca.if_else(usable, known[i], 0) for i in range(known.numel())]
        moved |= {"known": ca.vertcat(*kept), "x": ca.vertcat(X.lower, X.upper)}
        moved |= {"f": ca.vertcat(F.lower, F.upper), "parts": parts[: -newest.numel()]}
        following = ca.vertcat(*(moved[name[5:]] for name in self.layout))
        results = ca.cse([following, *self._open(mean), word])
        labels = ["memory", *self.sizes], ["next", *MEAN_OUTPUTS]
        return ca.Function("window", [memory, *ports], [*map(ca.densify, results)], *labels)

    def _open(self, mean: Ends) -> list[ca.SX]:
        """Write infinities for ends that some unbounded set went into."""
        huge, pairs = Rounding(self.precision).limits.huge, ((-1.0, mean.lower), (1.0, mean.upper))
        return [
            ca.vertcat(*(ca.if_else(s * e > huge, s * ca.inf, e) for e in ca.vertsplit(ends)))
            for s, ends in pairs
        ]

    def _mean(self, parts: ca.SX, now: list[Lifted]) -> Ends:
        """Enclose the means from (F, D, P) of m instants, the newest first, and P of this one."""
        rounding, n_f, q = Rounding(self.precision), len(self.plant.f), len(now)
        rows = [_unpacked(part) for part in ca.vertsplit(parts, 2 * (n_f + 2 * q))]

        def total(i: int) -> Lifted:
            terms = [Lifted(row.lower[i], row.upper[i]) for row in rows]
            return reduce(lambda a, b: combine("add", a, b, rounding=rounding), terms)

        sums = [[total(j)] for j in range(n_f)]
        for i, j in enumerate(self.relations[0]):
            end = n_f + q + i
            then = Lifted(rows[-1].lower[end], rows[-1].upper[end])
            moved = combine("subtract", now[i], then, rounding=rounding)
            sums[j].append(combine("subtract", moved, total(n_f + i), rounding=rounding))
        m, ends = Lifted.number(float(self.m)), []
        for told in sums:
            means = [combine("divide", one, m, rounding=rounding) for one in told]
            ends.append(reduce(Ends.meet, [Ends(mean.lower, mean.upper) for mean in means]))
        return Ends(ca.vertcat(*(e.lower for e in ends)), ca.vertcat(*(e.upper for e in ends)))

    def over(self, *columns: Any) -> list[FloatArray]:
        """Return mean_lower, mean_upper (N + 1, n_f), mean_status (N + 1,) of a run.

        columns: u, theta (or nothing), x_lower, x_upper, f_lower, f_upper, status, (N + 1, ...)
        """
        memory: Any = self.first
        N, found = len(columns[-1]), []
        rows = [np.asarray(c, dtype=float).reshape(N, -1).T for c in columns]
        runs: Any = {n: self.step.mapaccum(n) for n in {min(N, _CHUNK), N % _CHUNK} if n}
        for k in range(0, N, _CHUNK):
            part = [row[:, k : k + _CHUNK] for row in rows]
            moved, *means = runs[part[-1].size](memory, *part)
            memory = moved[:, -1]  # an array of the others would take longer than the means
            found.append(np.vstack([np.array(mean) for mean in means]))
        n_f, told = len(self.plant.f), np.hstack(found)
        return [told[:n_f].T, told[n_f:-1].T, told[-1].astype(np.int64)]


def _unpacked(ends: ca.SX) -> Ends:
    """Return a box from its lower ends with the upper ones behind."""
    half = ends.numel() // 2
    return Ends(ends[:half], ends[half:])
