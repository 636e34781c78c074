"""The extended plant: faults as states, unknown inputs taken away, the rest as disturbances.

For a discrete plant ``x+ = F(x, u, f, d, w), y = h(x, u, f, w)`` of any form, as docs/methods/
general_class.md tells it: the rows ``T0 F`` with ``T0 = I - L0 C``, ``L0 = D0 (C D0)^-1``, know
nothing of d, whatever its size, and ``x = T0 x + L0 C x``.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import sympy as sp

from obsynth.derive.errors import StructureError
from obsynth.derive.jacobian.entries import matrix_entries
from obsynth.derive.jacobian.family import find_dependences
from obsynth.derive.rigour import round_number, substitute
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.plant import Plant
from obsynth.symbolic.signals import Role, Signal


@dataclass(frozen=True, eq=False)
class Extended:
    """A plant whose states are those of another and its faults, with known and bounded signals.

    plant: states (x, followed faults), inputs (u, measured scheduling), disturbances v
    D0, L0, T0: exact matrices, shapes (N, k), (N, m), (N, N); L0 reads the outputs ``picked``
    """

    plant: Plant
    followed: tuple[str, ...]
    free: tuple[str, ...]
    D0: sp.Matrix
    L0: sp.Matrix
    T0: sp.Matrix
    picked: tuple[int, ...]

    def leak(self, L0: FloatArray, largest: FloatArray) -> FloatArray:
        """Bound what rounding L0 leaves of the unknown inputs in the states, (N,).

        ``|(I - L0 C) L0_exact C x|`` for ``|C x| <= largest``, shape (m,).
        """
        size = self.T0.shape[0]
        if not self.free:
            return np.zeros(size)
        given = sp.Matrix(*L0.shape, [sp.Rational(v) for v in L0.ravel().tolist()])
        left = (sp.eye(size) - given * self.output_slopes()) * self.L0
        found = np.zeros(size)
        for i, j in np.ndindex(*left.shape):
            if (value := left[i, j]) != 0:
                middle, error = round_number(sp.nsimplify(value) if value.is_Float else value)
                found[i] += (abs(middle) + error) * largest[j]
        return np.asarray(found * (1.0 + 2.0**-40))

    def output_slopes(self) -> sp.Matrix:
        """Return the constant slopes of the picked outputs, zero in other rows, (m, N)."""
        rows = [substitute(row, self.plant.constant_values) for row in self.plant.output]
        return _slopes(rows, self.plant.x, self.picked)


def extend(model: Plant, unfollowed: Sequence[str] = (), divided: Sequence[str] = ()) -> Extended:
    """Make the extended plant of a discrete one.

    `unfollowed` faults are disturbances, `divided` ones are taken away like unknown inputs.
    StructureError where these cannot be taken away, or a disturbance has no bound.
    """
    constants = model.constant_values
    rows = [substitute(row, constants) for row in model.rhs]
    outputs = [substitute(row, constants) for row in model.output]
    followed = [
        s
        for s in model.f
        if s.name not in (*unfollowed, *divided) and (s.rate is not None or s.constant)
    ]
    free = [s for s in model.d if not s.bounded]
    free += [s for s in model.f if s.name in divided]
    loose = [
        *(s for s in model.w),
        *(s for s in model.p),
        *(s for s in model.rho if not s.measured),
        *(s for s in model.d if s.bounded),
        *(s for s in model.f if s not in followed and s.name not in divided),
    ]
    unbounded = [s for s in loose if not s.bounded]
    if unbounded:
        first = unbounded[0]
        unbounded = [s for s in unbounded if s.role is first.role]
        more = ", or with rate= to have it followed" if first in model.f else ""
        raise StructureError(
            f"{first.role} {', '.join(s.name for s in unbounded)} has no bound, so no interval can "
            f"be guaranteed; declare it with bound= or range={more}",
            symbols=tuple(s.name for s in unbounded),
            condition="bounded disturbances",
        )
    taken = {s.name for s in model.signals} | set(model.output_names)
    steps = [_step(s, taken) for s in followed]
    for fault, step in zip(followed, steps, strict=True):
        moved = fault.symbol if step is None else fault.symbol + step.symbol
        rows.append(moved)
    states = [*model.x, *followed]
    size = len(states)
    _refuse_shown(outputs, free, model)
    D0, base = _span(rows, free, model)
    L0, picked = _left_inverse(D0, outputs, states, free, model)
    T0 = sp.eye(size) - L0 * _slopes(outputs, states, picked)
    if free:
        rows = [
            base[i] if T0[i, :] == sp.eye(size)[i, :] else sp.expand(T0[i, :].dot(sp.Matrix(base)))
            for i in range(size)
        ]
    noise = [*loose, *(step for step in steps if step is not None)]
    made = _assembled(model, states, noise, rows, outputs)
    return Extended(
        made,
        tuple(s.name for s in followed),
        tuple(s.name for s in free),
        D0,
        L0,
        T0,
        picked,
    )


def _assembled(
    model: Plant,
    states: list[Signal],
    noise: list[Signal],
    rows: list[sp.Expr],
    outputs: list[sp.Expr],
) -> Plant:
    """Return the plant of these states, disturbances, rows and outputs; inputs are the model's."""
    made = Plant(model.name)
    plain: dict[str, Any] = {"rate": None, "of": None, "constant": False, "value": None}
    made.add_signals([replace(s, role=Role.STATE, **plain) for s in states])
    made.add_signals(list(model.u))
    made.add_signals([replace(s, role=Role.INPUT, **plain) for s in model.rho if s.measured])
    plain |= {"nominal": None, "measured": True}
    made.add_signals([replace(s, role=Role.DISTURBANCE, **plain) for s in noise])
    made.dynamics(rows, Ts=model.exact_Ts)
    made.outputs(outputs, names=list(model.output_names))
    return made


def _step(fault: Signal, taken: set[str]) -> Signal | None:
    """Return the signal of a fault's increments; None for one that does not change."""
    if fault.constant:
        return None
    name = f"step_{fault.name}"
    while name in taken:
        name += "_"
    taken.add(name)
    rate = float(fault.rate or 0.0)
    return Signal(name, sp.Symbol(name, real=True), Role.DISTURBANCE, -rate, rate)


def _refuse_shown(outputs: list[sp.Expr], free: list[Signal], model: Plant) -> None:
    """Refuse signals of any size that stand in an output."""
    for name, row in zip(model.output_names, outputs, strict=True):
        seen = [s for s in free if row.has(s.symbol)]
        if seen:
            raise StructureError(
                f"{seen[0].role} {', '.join(s.name for s in seen)} stands in the output {name}, "
                "where nothing tells one of any size from noise: "
                + (
                    "BoundedErrorUIO follows it by its rate"
                    if seen[0] in model.f
                    else "declare it with range="
                ),
                symbols=tuple(s.name for s in seen),
            )


def _span(rows: list[sp.Expr], free: list[Signal], model: Plant) -> tuple[sp.Matrix, list[sp.Expr]]:
    """Return D0 and the rows without unknown inputs; rows less these lie in its span, proved."""
    size = len(rows)
    zero = {s.symbol: sp.Integer(0) for s in free}
    if not free:
        return sp.zeros(size, 0), rows
    idle = [s.name for s in free if not any(row.has(s.symbol) for row in rows)]
    if idle:
        raise StructureError(
            f"{free[0].role} {', '.join(idle)} enters no equation of the states",
            symbols=tuple(idle),
        )
    names = ", ".join(s.name for s in free)
    base = [row.subs(zero) for row in rows]
    left = [
        sp.Integer(0) if not row.free_symbols & set(zero) else row - kept
        for row, kept in zip(rows, base, strict=True)
    ]
    if any(kept.has(sp.nan, sp.zoo, sp.oo) for kept in base):
        raise StructureError(
            f"{free[0].role} {names}: the equations are not defined where it is zero; declare it "
            "with range=, as a bounded disturbance",
            symbols=tuple(s.name for s in free),
        )
    entries = matrix_entries({(i, 0): row for i, row in enumerate(left)}, model)
    sampled = entries.sample(corners=False)
    basis, dependences = find_dependences(entries.exact, sampled, entries.symbols)
    D0 = sp.zeros(size, len(basis))
    for column, (i, _) in enumerate(basis):
        D0[i, column] = 1
    for dependence in dependences:
        for other, weight in dependence.coefficients.items():
            D0[dependence.entry[0], basis.index(other)] = weight
    return D0, base


def _pivots(scaled: FloatArray, rank: int) -> list[int]:
    """Return rows that span the others."""
    from scipy.linalg import qr

    order = qr(scaled.T, pivoting=True, mode="r")[1]
    return sorted(int(k) for k in order[:rank])


def _slopes(outputs: list[sp.Expr], states: Sequence[Signal], picked: Sequence[int]) -> sp.Matrix:
    C = sp.zeros(len(outputs), len(states))
    for i in picked:
        C[i, :] = sp.Matrix([[sp.expand(sp.diff(outputs[i], s.symbol)) for s in states]])
    return C


def _left_inverse(
    D0: sp.Matrix,
    outputs: list[sp.Expr],
    states: list[Signal],
    free: list[Signal],
    model: Plant,
) -> tuple[sp.Matrix, tuple[int, ...]]:
    """Return ``D0 (C D0)^-1`` on some outputs of constant slopes, and these outputs."""
    size, m, k = len(states), len(outputs), D0.shape[1]
    if k == 0:
        return sp.zeros(size, m), ()
    names = tuple(s.name for s in free)
    moving = [s.symbol for s in (*states, *model.w, *model.p, *model.rho, *model.f)]
    constant = [i for i, row in enumerate(outputs) if _is_affine(row, moving)]
    C = _slopes(outputs, states, constant)
    CD = (C * D0).applyfunc(sp.nsimplify)
    numbers = np.array(CD.evalf(17).tolist(), dtype=float).reshape(m, k)
    for i in range(m):
        if i not in constant and any(
            sp.diff(outputs[i], s.symbol) != 0 and any(D0[j, c] != 0 for c in range(k))
            for j, s in enumerate(states)
        ):
            numbers[i] = 0.0
    noise = np.array([_noise(row, model) for row in outputs])
    weighted = numbers / noise[:, None]
    norms = np.linalg.norm(weighted, axis=0)
    rank = np.linalg.matrix_rank(weighted / np.where(norms > 0, norms, 1.0), tol=1e-9)
    if rank < k:
        acts = [s.name for i, s in enumerate(states) if any(D0[i, c] != 0 for c in range(k))]
        raise StructureError(
            f"rank(C D0) = {rank} but {free[0].role} {', '.join(names)} acts in {k} directions, on "
            f"{', '.join(acts)}: no output of constant slopes ({', '.join(model.output_names)}) "
            f"shows it one step later. Measure {acts[0]}, or declare {names[0]} with range=, as a "
            "bounded disturbance",
            condition="rank(C D) = rank(D)",
            symbols=names,
        )
    picked = tuple(_pivots(weighted, k))
    inverse = CD.extract(list(picked), list(range(k))).inv()
    L0 = sp.zeros(size, m)
    part = D0 * inverse
    for column, i in enumerate(picked):
        L0[:, i] = part[:, column]
    return L0, picked


def _is_affine(row: sp.Expr, symbols: Sequence[sp.Symbol]) -> bool:
    """Whether all slopes of a row are numbers."""
    present = [s for s in symbols if row.has(s)]
    return all(not sp.expand(sp.diff(row, s)).free_symbols for s in present)


def _noise(row: sp.Expr, model: Plant) -> float:
    """Return how far the disturbances of an output reach, a number above zero."""
    total = 0.0
    for s in model.w:
        if row.has(s.symbol) and s.bounded:
            slope = sp.diff(row, s.symbol)
            if not slope.free_symbols:
                total += abs(float(slope)) * 0.5 * (s.upper - s.lower)
    return total or 1e-9
