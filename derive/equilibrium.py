"""Equilibria: where a plant stays for given inputs."""

from dataclasses import dataclass, field, replace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from obsynth.derive.errors import DerivationError
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.plant import Plant
from obsynth.symbolic.table import Table, Tabled
from obsynth.symbolic.taking import takes

_STARTS = 32
_ITERATIONS = 60
_HALVINGS = 30
_VALUES = 4_000
# A step that leaves more than this share of the residual leads nowhere, and so do a few of them.
_SLOW, _PATIENCE = 0.99, 3
_NO_VALUES: FloatArray = np.zeros(0)


@dataclass(frozen=True, eq=False, repr=False)
class Equilibrium(Tabled):
    """A point of operation.

    Attributes
    ----------
    x : ndarray, shape (n,)
        State, in the units of the plant.
    u : ndarray, shape (n_u,)
        Input that holds it.
    residual : float
        Largest |f(x, u)| (continuous time) or |f(x, u) - x| (discrete time), with unknown inputs,
        faults and disturbances at zero.
    p, rho : ndarray
        Values of uncertain parameters and scheduling variables that belong to it.
    """

    x: FloatArray
    u: FloatArray
    residual: float
    p: FloatArray = field(default_factory=lambda: _NO_VALUES)
    rho: FloatArray = field(default_factory=lambda: _NO_VALUES)

    def __repr__(self) -> str:
        kinds = [(kind, getattr(self, kind)) for kind in ("x", "u", "p", "rho")]
        told = [f"{k} = ({', '.join(f'{v:.6g}' for v in part)})" for k, part in kinds if part.size]
        return f"<Equilibrium: {', '.join(told)}>"

    def table(self) -> Table:
        """Tabulate the values and the residual."""
        kinds = {"x": self.x, "u": self.u, "p": self.p, "rho": self.rho}
        rows = [[kind, ", ".join(f"{v:.6g}" for v in part)] for kind, part in kinds.items()]
        shown = [row for row in rows if row[1]]
        return Table("Equilibrium", ("", ""), [*shown, ["residual", f"{self.residual:.2g}"]])


def operating_values(model: Plant, kind: str) -> FloatArray:
    """Nominal values of one kind of signal: declared, else the middle of the range, else zero."""
    return np.array([s.usual for s in getattr(model, kind)], dtype=float)


def _finite(values: FloatArray, names: tuple[str, ...], what: str) -> FloatArray:
    """Refuse what is not one finite number for each name."""
    if values.shape != (len(names),) or not np.isfinite(values).all():
        raise DerivationError(
            f"{what} needs one finite number for each of {', '.join(names) or 'no inputs'}; "
            f"given was {values.tolist()}",
            symbols=names,
            given=values,
        )
    return values


def _inputs(model: Plant, u: ArrayLike | None) -> FloatArray:
    if u is None:
        for signal in model.u:
            if signal.nominal is None and not signal.bounded:
                raise DerivationError(
                    f"the input {signal.name} has neither a nominal value nor a range; give "
                    f"u= or declare it with nominal=",
                    symbol=signal.name,
                )
        return operating_values(model, "u")
    return _finite(np.atleast_1d(np.asarray(u, dtype=float)), model.names("u"), "u")


def _residual_functions(model: Plant) -> tuple[ca.Function, ca.Function]:
    """Return what is to vanish, and its derivative by the state."""
    sx = model.sx()
    residual = sx.rhs - sx.x if model.Ts is not None else sx.rhs
    quiet = ca.vertcat(sx.f, sx.w)
    residual = ca.substitute(residual, quiet, ca.SX.zeros(quiet.numel()))
    residual = ca.substitute(residual, sx.d, ca.SX(operating_values(model, "d")))
    arguments = [sx.x, sx.u, sx.p, sx.rho]
    slope = ca.cse(ca.jacobian(residual, sx.x))
    return ca.Function("residual", arguments, [residual]), ca.Function("slope", arguments, [slope])


def _newton(
    functions: tuple[ca.Function, ca.Function], start: FloatArray, given: list[Any]
) -> tuple[FloatArray, float, int]:
    """Return where Newton's method ends, what is left there, and how many values that took."""
    x, value = start, np.array(functions[0](start, *given)).ravel()
    count, slow = 1, 0
    for _ in range(_ITERATIONS):
        slope = np.array(functions[1](x, *given))
        if not (np.isfinite(value).all() and np.isfinite(slope).all()):
            return x, np.inf, count
        size = float(np.abs(value).max(initial=0.0))
        if size == 0.0 or slow == _PATIENCE:
            break
        # least squares: an integrator makes the Jacobian singular without making it useless
        step = np.linalg.lstsq(slope, -value, rcond=None)[0]
        for halving in range(_HALVINGS):
            trial = x + step * 0.5**halving
            trial_value = np.array(functions[0](trial, *given)).ravel()
            count += 1
            left = float(np.abs(trial_value).max(initial=0.0))
            if left < size:
                break
        else:
            break
        slow = slow + 1 if left > _SLOW * size else 0
        x, value = trial, trial_value
    return x, float(np.abs(value).max(initial=0.0)), count


@takes(model="Plant")
def equilibrium(model: Plant, u: ArrayLike | None = None) -> Equilibrium:
    """Find the state that given inputs hold.

    Newton's method with step halving, from the nominal state or the middle of the state's range
    and then from a fixed set of further points of that range.

    Parameters
    ----------
    model : Plant
        Continuous or discrete plant. Unknown inputs have their nominal values, the middle of their
        range or zero, as they say; faults and disturbances are zero.
    u : array_like, shape (n_u,), optional
        Inputs; by default their nominal values, else the middle of their range.

    Returns
    -------
    Equilibrium
        State, input and what is left of the equations.

    Raises
    ------
    DerivationError
        No equilibrium was found inside the range of the states; an input without a value.

    Examples
    --------
    >>> from obsynth.symbolic.plants import quadruple_tank
    >>> point = equilibrium(quadruple_tank(), u=[10, 10])
    >>> [round(float(level), 6) for level in point.x]
    [130.118142, 172.57532, 31.304892, 38.805004]
    """
    inputs = _inputs(model, u)
    p, rho = operating_values(model, "p"), operating_values(model, "rho")
    box = model.box("x")
    functions = _residual_functions(model)
    first = operating_values(model, "x")
    finite = np.isfinite(box).all(axis=1)
    width = np.where(
        finite, np.where(finite, box[:, 1], 0.0) - np.where(finite, box[:, 0], 0.0), 2.0
    )
    rng = np.random.default_rng(0)
    outside: FloatArray | None = None
    spent = 0
    for attempt in range(_STARTS):
        if spent > _VALUES:
            break
        start = first if attempt == 0 else first + width * (rng.random(len(first)) - 0.5)
        start = np.clip(start, box[:, 0], box[:, 1])
        x, residual, count = _newton(functions, start, [inputs, p, rho])
        spent += count
        scale = 1.0 + float(np.abs(x).max(initial=0.0))
        if residual > 1e-9 * scale:
            continue
        if (x >= box[:, 0]).all() and (x <= box[:, 1]).all():
            return Equilibrium(x, inputs, residual, p, rho)
        outside = x
    if outside is None:
        raise DerivationError(
            f"no equilibrium of {model.name!r} was found for u = {inputs.tolist()}; give the point "
            "of operation with at=(x, u), or other inputs",
            u=inputs,
        )
    names = model.names("x")
    wrong = [k for k in range(len(names)) if not box[k, 0] <= outside[k] <= box[k, 1]]
    listed = ", ".join(f"{names[k]} = {outside[k]:.6g} (range {box[k].tolist()})" for k in wrong)
    raise DerivationError(
        f"for u = {inputs.tolist()} the plant {model.name!r} rests outside the range of its "
        f"states: {listed}; change the inputs or widen the range",
        x=outside,
        u=inputs,
        symbols=tuple(names[k] for k in wrong),
    )


def operating_point(model: Plant, at: Any = None) -> Equilibrium:
    """Read a point of operation, or find the nominal one.

    Where no equilibrium is found, the nominal values or the middles of the ranges serve: a split
    is right at any point.
    """
    if at is None:
        inputs = _inputs(model, None)
        try:
            return equilibrium(model)
        except DerivationError:
            at = operating_values(model, "x"), inputs
    if isinstance(at, Equilibrium):
        point = at
    else:
        try:
            x, u = (np.atleast_1d(np.asarray(part, dtype=float)) for part in at)
        except (TypeError, ValueError) as error:
            raise DerivationError(
                f"at= is an Equilibrium or a pair (x, u); given was {at!r}", given=at
            ) from error
        rest = (operating_values(model, kind) for kind in ("p", "rho"))
        point = Equilibrium(x, u, np.nan, *rest)
    for kind, values in (("x", point.x), ("u", point.u)):
        _finite(values, model.names(kind), "the point of operation")
    if np.isnan(point.residual):
        left = np.array(_residual_functions(model)[0](point.x, point.u, point.p, point.rho))
        point = replace(point, residual=float(np.abs(left).max(initial=0.0)))
    return point
