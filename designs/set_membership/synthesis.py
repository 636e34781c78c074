"""Gain, coordinates and numbers of columns: candidates, and the choice by what they predict.

Gains are those of a Kalman filter at the point of operation with shares of the readings' noise,
or of peak bounds; see the options. Whatever is chosen, the sets hold.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from obsynth.derive.errors import StructureError
from obsynth.derive.rigour import Enclosure, product_up
from obsynth.designs.core.errors import InfeasibleDesign, SolverTrouble
from obsynth.designs.general.record import GeneralDesign
from obsynth.designs.set_membership.model import Around, SetMembershipModel
from obsynth.designs.set_membership.prediction import LONGEST, Bank, Predicted, predict
from obsynth.designs.set_membership.record import MOST_COLUMNS, SetMembershipDesign
from obsynth.designs.set_membership.zonotope import Frame
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError

Coordinates = Literal["modal", "covariance", "states"]
Gain = tuple[FloatArray, FloatArray]
"""A gain (N, m) and coordinates (N, N)."""
SHARES = (0.1, 0.3, 1.0, 3.0)
"""Of the readings' noise, for the filter's gain."""
KEPT = (1, 2, 3, 5, 8, 12)
"""Calls for which generators are kept, as tried."""
COMPARED = 8
"""Of these, with which gains are compared."""
NARROW = 0.1
"""Share of the ranges that predictions begin from where these themselves say nothing."""
LARGE = 8000
"""Size of a bank, about a ninth of its operations, that has to halve the predicted mean to pay."""
CUT = 1.5
"""Operations of a zonotope that is cut, relative to those of the one that is corrected."""
SHORTEST = 4
"""Calls after which a zonotope begins anew at the earliest, where nothing is said."""
_WORST_BASIS = 1e8
_DECAYS, _HIDDEN = 1.0 - 1e-7, 1e-9
_FLOOR = 1e-6


def hidden(A: FloatArray, C: FloatArray) -> list[tuple[complex, FloatArray]]:
    """Return modes that do not decay and that no output sees, with sizes of their vectors."""
    found = []
    for value in np.linalg.eigvals(A):
        if abs(value) >= _DECAYS:
            stacked = np.vstack([A - value * np.eye(len(A)), C])
            _, sizes, vectors = np.linalg.svd(stacked)
            if sizes[-1] < _HIDDEN:
                found.append((complex(value), np.abs(vectors[-1])))
    return found


def scaled(model: SetMembershipModel, around: Around) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return A and C in units of half ranges and of the readings' noise, and the latter (m,)."""
    half = model.half
    noise = np.maximum(around.sigma, _FLOOR * (np.abs(around.H) @ half))
    noise = np.where(noise > 0.0, noise, 1.0)
    return around.J * half / half[:, None], around.H * half / noise[:, None], noise


def watched(model: SetMembershipModel) -> SetMembershipModel:
    """Leave faults that nothing shows within their ranges; refuse states that nothing shows."""
    while True:
        A, C, _ = scaled(model, model.nearest)
        modes = hidden(A, C)
        n, plant = len(model.plant.x), model.plant
        names = (*plant.names("x"), *(plant.names("f")[j] for j in model.followed))
        for value, vector in modes:
            moved = [int(i) for i in np.argsort(-vector) if vector[i] > 1e-6 * vector.max()]
            faults = [i - n for i in moved if i >= n]
            if faults:
                lost = min(faults, key=lambda k: float(model.half[n + k]))
                model = SetMembershipModel(plant, np.delete(model.followed, lost))
                break
            loose = [names[i] for i in moved if not plant.x[i].bounded]
            if loose:
                raise StructureError(
                    f"a mode {abs(value):.6g} of {', '.join(names[i] for i in moved)} does not "
                    f"decay, no output shows it ({', '.join(plant.output_names)}), and "
                    f"{', '.join(loose)} has no declared range: measure one of them, or declare it",
                    symbols=tuple(loose),
                    condition="detectability",
                )
        else:
            return model


def kalman(
    model: SetMembershipModel, around: Around, share: float
) -> tuple[FloatArray, FloatArray]:
    """Return the filter's gain at the point of operation and the root of its covariance."""
    from scipy.linalg import solve_discrete_are

    A, C, noise = scaled(model, around)
    half = model.half
    C = C / share
    columns = around.columns / half[:, None]
    Q = columns @ columns.T + np.diag((around.spread / half) ** 2 + _FLOOR**2)
    # what nothing shows and what does not decay would have no covariance
    slow = A * (1.0 - 1e-6)
    for value, vector in hidden(A, C):
        slow = slow - np.outer(vector, vector) * (abs(value) - 0.9) * (abs(value) > 0.9)
    try:
        P = solve_discrete_are(slow.T, C.T, Q, np.eye(len(C)))
    except (np.linalg.LinAlgError, ValueError) as error:
        raise SolverTrouble(
            "set membership: the filter's Riccati equation at the point of operation has no "
            "solution in doubles; give gains through analyse(plant, {'L': ...})"
        ) from error
    S = C @ P @ C.T + np.eye(len(C))
    L = np.linalg.solve(S, C @ P).T
    after = P - L @ C @ P
    L = L * half[:, None] / (share * noise)
    L[np.abs(L) < 1e-12 * half[:, None] / noise] = 0.0
    values, vectors = np.linalg.eigh(0.5 * (after + after.T))
    root = vectors * np.sqrt(np.maximum(values, 1e-14 * values.max()))
    return L, half[:, None] * (root @ vectors.T)


def modes(closed: FloatArray, half: FloatArray) -> FloatArray | None:
    """Return a real basis of the modes of a matrix, None where they are nearly dependent."""
    values, vectors = np.linalg.eig(closed * half / half[:, None])
    columns = []
    for value, vector in zip(values, vectors.T, strict=True):
        if abs(value.imag) < 1e-9:
            columns.append(vector.real)
        elif value.imag > 0.0:
            # turned so that real and imaginary part are orthogonal: nearest to a rotation
            turned = vector * np.exp(-0.5j * np.angle(vector @ vector))
            columns += [turned.real, turned.imag]
    basis = np.array(columns).T
    if basis.shape != closed.shape:
        return None
    return half[:, None] * basis if np.linalg.cond(basis) < _WORST_BASIS else None


def peak_gain(model: SetMembershipModel, peak: GeneralDesign) -> FloatArray | None:
    """Return the gain of an observer with peak bounds, in the coordinates of the zonotopes."""
    n, names = len(model.plant.x), model.plant.names("f")
    known, wanted = peak.extended.followed, [names[j] for j in model.followed]
    if not {*wanted} <= {*known}:
        return None
    rows = [*range(n), *(n + known.index(name) for name in wanted)]
    return np.asarray(peak.L[rows])


def candidates(
    model: SetMembershipModel,
    peak: GeneralDesign | None,
    shares: tuple[float, ...],
    kinds: tuple[Coordinates, ...],
) -> Iterator[Gain]:
    """Yield gains with coordinates for the reduction; the first is that of the peak bounds."""
    around = model.nearest
    gains: list[tuple[FloatArray, FloatArray | None]] = []
    if peak is not None and (L := peak_gain(model, peak)) is not None:
        gains.append((L, None))
    gains += [kalman(model, around, share) for share in shares]
    for L, root in gains:
        closed = (np.eye(len(L)) - L @ around.H) @ around.J
        bases = {
            "modal": modes(closed, model.half),
            "covariance": root,
            "states": np.diag(model.half),
        }
        for kind in kinds:
            basis = bases[kind]
            if basis is not None:
                yield L, basis


@dataclass(frozen=True, eq=False)
class Wishes:
    """What the options say of a bank; None for the choice.

    weights: of states and faults in the mean of half widths, in units of half their ranges
    held: half widths that are guaranteed whatever the bank is, infinite where none is
    fitting: whether a number of operations has to be kept to
    """

    columns: int | None
    zonotopes: int | None
    restart: int | None
    weights: FloatArray
    held: FloatArray
    fitting: bool

    def mean(self, model: SetMembershipModel, found: Predicted) -> float:
        """Return the weighted mean of half widths over half ranges."""
        half = declared(model.plant)
        unit = np.where(np.isfinite(half) & (half > 0.0), half, 1.0)
        return float(self.weights @ (found.widths / unit)) / float(self.weights.sum())

    def kept(self, model: SetMembershipModel) -> int:
        """Return for how many calls generators can be kept in the most columns."""
        most, group = self.columns or MOST_COLUMNS, model.group
        if most < group:
            raise ObsynthError(
                f"columns is {most}; a zonotope of {len(model.half)} coordinates needs {group}, "
                "those of one call",
                option="columns",
            )
        return most // group


@dataclass(frozen=True, eq=False)
class Tried:
    """A bank, what it predicts from a share of the ranges, the mean, the size."""

    bank: Bank
    found: Predicted
    mean: float
    size: float
    share: float


def choose(model: SetMembershipModel, gains: list[Gain], wishes: Wishes) -> list[Tried]:
    """Return banks around the gain of the least predicted mean, the one to be preferred first.

    A larger bank is preferred where what it predicts pays for its size, and the narrowest where
    there is a number of operations to keep to.
    """
    most = wishes.kept(model)

    def tried(gain: Gain, kept: int, zonotopes: int, share: float) -> Tried:
        restart = max(kept, SHORTEST, zonotopes) if wishes.restart is None else wishes.restart
        (L, V), columns = gain, kept * model.group
        bank = Bank(L, V, inverse(V), columns, zonotopes, restart)
        found = predict(model, bank, wishes.held, share)
        if share < 1.0:  # how long the sets take to become as narrow is not known
            found = replace(found, calls=max(found.calls, LONGEST))
        size = columns * (1.0 + CUT * zonotopes) * len(V) * (L.shape[1] + 6)
        return Tried(bank, found, wishes.mean(model, found), size, share)

    counts = (0, 1) if wishes.zonotopes is None else (wishes.zonotopes,)
    # over ranges that are wide the equations may say nothing, whatever the gain is
    for share in (1.0, NARROW):
        compared = [tried(gain, min(COMPARED, most), counts[-1], share) for gain in gains]
        best = min(compared, key=lambda one: one.mean)
        if np.all((best.found.widths < declared(model.plant))[: len(model.plant.x)]):
            break
    lengths = [most] if wishes.columns is not None else [kept for kept in KEPT if kept <= most]
    chosen = best.bank.L, best.bank.V
    banks = [tried(chosen, kept, count, share) for kept in lengths for count in counts]
    if wishes.fitting:
        return sorted(banks, key=lambda one: one.mean)
    return sorted(banks, key=lambda one: one.mean * (1.0 + one.size / LARGE))


def declared(plant: Plant) -> FloatArray:
    """Return half the declared ranges, states then faults, (n + n_f,)."""
    box = np.vstack([plant.box("x"), plant.box("f").reshape(-1, 2)])
    return np.asarray(0.5 * np.diff(box, axis=1)[:, 0])


def inverse(V: FloatArray) -> FloatArray:
    """Return nearly the inverse."""
    return np.asarray(np.linalg.inv(V), dtype=float)


def frame(V: FloatArray) -> Frame:
    """Return coordinates with numbers that prove their inverse, see `Frame`."""
    N = len(V)
    W = inverse(V)
    off = off_identity(V, W)
    size = np.abs(W) @ (np.eye(N) + 2.0 * off) * (1.0 + 2.0**-40)
    return Frame(V, W, size, product_up(size, off) * (1.0 + 2.0**-40))


def off_identity(V: FloatArray, W: FloatArray) -> FloatArray:
    """Bound ``|I - V W|``, (N, N)."""
    found = Enclosure.of(np.eye(len(V))) - Enclosure.of(V) @ W
    return np.asarray(np.abs(found.mid) + found.rad) * (1.0 + 2.0**-40)


def closed_loop(design: SetMembershipDesign) -> FloatArray:
    """Bound ``|V^-1 ((I - L C) A)^kept V|`` with the stored numbers, (N, N)."""
    eye = Enclosure.of(np.eye(len(design.V)))
    closed = (eye - Enclosure.of(design.L) @ design.C) @ Enclosure.of(design.A)
    moved = Enclosure.of(design.V)
    for _ in range(design.kept):
        moved = closed @ moved
    own = Enclosure.of(design.W) @ moved
    size = np.abs(moved.mid) + moved.rad
    return np.asarray(np.abs(own.mid) + own.rad + product_up(design.leak, size)) * (1.0 + 2.0**-40)


def radius_bound(matrix: FloatArray) -> float:
    """Bound the spectral radius of a nonnegative matrix by a positive vector."""
    v = np.full(len(matrix), 1.0)
    for _ in range(200):
        v = matrix @ v + 1e-12 * v.max()
        v = v / v.max()
    image = product_up(matrix, v[:, None])[:, 0]
    return float((image / v).max()) * (1.0 + 2.0**-40)


def complete(
    model: SetMembershipModel,
    chosen: Tried,
    peak: GeneralDesign | None,
    options: Mapping[str, Any],
) -> SetMembershipDesign:
    """Return the design of a choice."""
    bank, names = chosen.bank, model.plant.names("f")
    held = frame(bank.V)
    design = SetMembershipDesign(
        plant=model.plant,
        followed=tuple(names[j] for j in model.followed),
        L=bank.L,
        V=held.V,
        W=held.W,
        size=held.size,
        leak=held.leak,
        A=model.nearest.J,
        C=model.nearest.H,
        columns=bank.columns,
        kept=bank.columns // model.group,
        zonotopes=bank.zonotopes,
        restart=bank.restart,
        contraction=0.0,
        predicted=chosen.found.widths,
        share=chosen.share,
        settles=chosen.found.calls,
        peak=peak,
        options=options,
    )
    rho = radius_bound(closed_loop(design))
    return replace(design, contraction=rho)


def refuse_wide(model: SetMembershipModel, found: Predicted) -> None:
    """Refuse a plant of which nothing more is told than its declared ranges."""
    plant = model.plant
    if np.any(found.widths < declared(plant)):
        return
    names = ", ".join((*plant.names("x"), *plant.names("f")))
    raise InfeasibleDesign(
        f"the sets of {names} are all predicted to be as wide as the declared ranges",
        [
            f"the outputs {', '.join(plant.output_names)} say too little of them for the declared "
            "disturbances: measure more, declare smaller bounds, or narrow the ranges",
        ],
        states=plant.names("x"),
    )
