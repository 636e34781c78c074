"""Efimov, Raissi, Zolghadri: what is printed of the set adaptive observer, and what holds."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import sympy as sp

from obsynth.designs import InfeasibleDesign, SetAdaptiveObserver
from obsynth.designs.core.observer import Observer
from obsynth.designs.set_adaptive.indicators import fault_indicators, monitors
from obsynth.evaluate.papers.claim import Claim
from obsynth.symbolic import Plant, plants
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.scenarios.three_tanks import three_tanks_control

_L = 3.0 * np.eye(3, 2)
_FAULTS = (8e-5, 6e-5)
_THETA = 1e-4
_DELAY = 0.45
_GRID = 0.001

Rates = Callable[[float, FloatArray], FloatArray]


def claims() -> Iterator[Claim]:
    """Try the gain and its condition, the order of the laws, and the run of Section 6."""
    plant = plants.three_tanks()
    yield _volumes(plant)
    printed = SetAdaptiveObserver(form="printed")
    observer = printed.analyse(plant, {"L": _L})
    alpha = observer.performance["alpha"]
    yield Claim(
        "Section 6",
        "with L = 3 [I; 0] A_m - L C is Metzler and A_M - L C Hurwitz",
        f"over all levels, with a decay of {alpha:.5f} 1/s",
        alpha > 0.0,
    )
    try:
        printed.design(plant)
    except InfeasibleDesign as error:
        yield Claim("gain condition", "L = p w' is such a gain", _second(error), False)
    upper = _coupled_bound()
    yield Claim(
        "(8), (12)",
        "the bounds of the faults keep their order",
        f"with two coupled faults of 1 and .3, the upper bound of the second falls to {upper:.4f}",
        upper >= 0.3,
    )
    yield from _run(plant, observer)


def _volumes(plant: Plant) -> Claim:
    """Flows between the tanks cancel in the sum of all volumes."""
    symbols = {str(s): s for s in sp.Matrix(plant.rhs).free_symbols}
    x2, x3 = symbols["x2"], symbols["x3"]
    between = symbols["a32"] * sp.sign(x3 - x2) * sp.sqrt(sp.Abs(x3 - x2)) / symbols["S_c"]
    left = sp.simplify(sp.diff(sum(plant.rhs), symbols["a32"]))
    printed = sp.simplify(sp.diff(sum(plant.rhs) - 2 * between, symbols["a32"]))
    said = "leaves the volume alone with +" if left == 0 else "does not"
    return Claim(
        "(19), row 2",
        "the flow a32 rho(x3 - x2) leaves tank 2",
        f"it comes from tank 3: {said}, as (20) has it",
        printed == 0,
    )


def _second(error: InfeasibleDesign) -> str:
    return str(error).splitlines()[2].strip()


def _coupled_bound() -> float:
    """Return the least that the printed "upper" bound of a fault of .3 becomes."""
    plant = Plant("coupled faults")
    x1, x2 = plant.states("x1:3", range=(0, 5))
    u1, u2 = plant.inputs("u1:3", range=(0, 1))
    (a,) = plant.scheduling("a", range=(-1.5, -0.9), measured=False)
    f1, f2 = plant.faults("theta1:3", range=(-2, 2))
    plant.dynamics([a * x1 + x2 / 10 + u1 + f1 + f2 / 2, x1 / 10 - x2 + u2 + f1 / 2 + f2])
    plant.outputs([x1, x2])
    method = SetAdaptiveObserver(law="printed", Gamma=0.1)
    observer = method.analyse(plant, {"L": np.zeros((2, 2))})
    A, G = np.array([[-1.0, 0.1], [0.1, -1.0]]), np.array([[1.0, 0.5], [0.5, 1.0]])
    u, drift = np.array([0.5, 0.5]), G @ [1.0, 0.3]
    start = observer.memory0([1, 1], x_range=[(1, 1), (1, 1)], f_range=[(-2, 2)] * 2)

    def rates(_: float, z: FloatArray) -> FloatArray:
        return np.concatenate([A @ z[:2] + u + drift, _ode(observer, z[2:], u, z[:2])])

    _, found = _integrated(rates, (0.0, 200.0), np.concatenate([[1.0, 1.0], start]))
    bound: FloatArray = found[2:][observer.memory_layout["theta_m"]][1]
    return float(bound.min())


def _run(plant: Plant, observer: Observer) -> Iterator[Claim]:
    """Integrate plant, control and observer of Section 6 without noise."""
    box, law = plant.box("x"), three_tanks_control(0.01)
    function, n = plant.function(), len(plant.x)
    start = observer.memory0([0.5, 0.1, 0.3], f_range=[(-_THETA, _THETA)] * 2)
    state = np.concatenate([[0.5, 0.1, 0.3], start])
    left: dict[str, float] = {}
    pieces = ((100.0, (0, 0)), (200.0, (0, 0)), (300.0, (1, 0)), (306.0, (1, 1)))
    begin = 0.0
    for end, there in pieces:
        fault = np.array(_FAULTS) * there

        def rates(
            t: float, z: FloatArray, fault: FloatArray = fault, middle: float = begin + 1.0
        ) -> FloatArray:
            # the reference of the whole piece, whatever t the last stage has
            u = np.array(law(middle / 0.01, z[:2]))
            moved = np.array(function(z[:n], u, [], fault, [0.0, 0.0], [], [])[0]).ravel()
            return np.concatenate([moved, _ode(observer, z[n:], u, z[:2])])

        t, found = _integrated(rates, (begin, end), state)
        for i, name in enumerate(plant.names("x")):
            outside = np.flatnonzero(found[i] > box[i, 1])
            if outside.size:
                left.setdefault(name, float(t[outside[0]]))
        if begin in (200.0, 300.0):
            yield _delay(observer, t - begin, found, 1 if begin == 200.0 else 2)
        state = found[:, -1]
        if end == 200.0:
            yield from _before(observer, state[n:], state[:2])
        begin = end
    told = ", ".join(f"{name} at {at:.2f} s" for name, at in left.items())
    yield Claim(
        "Section 6", "the levels stay in X", f"{told} leave it" if told else "yes", not told
    )


def _before(observer: Observer, memory: FloatArray, y: FloatArray) -> Iterator[Claim]:
    """Try what is said of the faults before there is one."""
    limit = float(monitors(observer, memory).limit_m.max())
    yield Claim(
        "Theorem 1 (ii)",
        "the largest fault is below R_m^-1 b_m",
        f"{_THETA:g} is above {limit:.3g}",
        limit > _THETA,
    )
    alarm = bool(fault_indicators(observer, memory, y, form="printed").D)
    said = "an alarm" if alarm else "no alarm"
    yield Claim("(17)", "no alarm without a fault", f"{said} at 200 s, before any fault", not alarm)


def _delay(observer: Observer, t: FloatArray, found: FloatArray, which: int) -> Claim:
    """When the interval of a fault leaves zero."""
    memory, i = found[3:], which - 1
    upper = memory[observer.memory_layout["theta_m"]][i]
    lower = memory[observer.memory_layout["theta_M"]][i]
    seen = np.flatnonzero((lower > 0.0) | (upper < 0.0))
    first = float(t[seen[0]]) if seen.size else None
    said = f"after {t[-1]:g} s not yet" if first is None else f"after {first:.3f} s"
    return Claim(
        "Section 6",
        f"fault {which} is found within {_DELAY:g} s",
        said,
        first is not None and first <= _DELAY,
    )


def _ode(observer: Observer, memory: FloatArray, u: Any, y: Any) -> FloatArray:
    assert observer.ode is not None
    return np.array(observer.ode(memory, u, y)).ravel()


def _integrated(
    rates: Rates, span: Sequence[float], start: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return instants and states, (N,) and (n, N), from Runge-Kutta of order 8."""
    from scipy.integrate import solve_ivp

    t = np.linspace(span[0], span[1], round((span[1] - span[0]) / _GRID) + 1)
    options = {"method": "DOP853", "rtol": 1e-9, "atol": 1e-12, "t_eval": t}
    found = solve_ivp(rates, tuple(span), start, **options)
    return found.t, found.y
