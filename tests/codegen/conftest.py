"""Toy observers: small enough to read, with everything that makes generated C difficult."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
import pytest

from obsynth.symbolic.signals import Signal

FINITE = 1e300


@dataclass
class ToySignal:
    """What the generator looks at of a signal, names that no plant would have included."""

    name: str
    unit: str
    lower: float = -np.inf
    upper: float = np.inf
    nominal: float | None = None
    bounded, middle, usual = Signal.bounded, Signal.middle, Signal.usual


@dataclass
class ToyPlant:
    """Two tanks in a row with a pump fault, as far as the generator looks at a plant."""

    name: str = "two tanks"
    Ts: float | None = 0.5
    output_names: tuple[str, ...] = ("level 1", "level 2")
    output_units: tuple[str, ...] = ("cm", "cm")
    boxes: dict[str, Any] = field(
        default_factory=lambda: {
            "x": [(1.0, 50.0), (1.0, 40.0)],
            "u": [(0.0, 10.0)],
            "d": [],
            "f": [(-np.inf, np.inf)],
            "w": [(-0.1, 0.1), (-0.1, 0.1)],
            "p": [],
            "rho": [],
        }
    )

    def box(self, kind: str) -> np.ndarray:
        return np.array(self.boxes[kind], dtype=float).reshape(-1, 2)

    def _signals(self, kind: str, names: tuple[str, ...], unit: str) -> tuple[ToySignal, ...]:
        nominal = 4.0 if kind == "u" else None
        ends = self.box(kind).tolist()
        return tuple(
            ToySignal(name, unit, *pair, nominal) for name, pair in zip(names, ends, strict=False)
        )

    @property
    def x(self) -> tuple[ToySignal, ...]:
        return self._signals("x", ("h_1", "h_2"), "cm")

    @property
    def u(self) -> tuple[ToySignal, ...]:
        return self._signals("u", ("v*/",), "V")

    @property
    def f(self) -> tuple[ToySignal, ...]:
        return self._signals("f", ("φ",), "V")

    def __getattr__(self, kind: str) -> tuple[ToySignal, ...]:
        if kind not in ("d", "w", "p", "rho"):
            raise AttributeError(kind)
        return self._signals(kind, tuple(f"{kind}{k}" for k in range(len(self.boxes[kind]))), "")

    def function(self) -> ca.Function:
        names = ("x", "u", "d", "f", "w", "p", "rho")
        s = {name: ca.SX.sym(name, len(self.boxes[name])) for name in names}
        x, w = s["x"], s["w"]
        v = ca.sum1(s["u"]) + ca.sum1(s["f"])
        root = ca.sqrt(ca.fmax(x, 0))
        rhs = x + self.Ts * ca.vertcat(0.8 * v - root[0], root[0] - root[1])
        return ca.Function("plant", list(s.values()), [rhs, x + w])

    def to_dict(self) -> dict[str, Any]:
        return {"name": self.name, "Ts": self.Ts, "boxes": {"x": [[1.0, 50.0], [1.0, 40.0]]}}


def toy_step(n_u: int = 1, n_f: int = 1, limit: float = FINITE, **changes: Any) -> ca.Function:
    """Return a step with roots, branches to infinity, a shifted measurement, a flag."""
    memory = ca.SX.sym("memory", 6)
    u, y = ca.SX.sym("u", n_u), ca.SX.sym("y", 2)
    y_last, flag, width, fault, z = memory[0], memory[1], memory[2], memory[3], memory[4:6]
    finite = ca.if_else(ca.fabs(ca.sum1(u)) <= limit, 1, 0)
    for i in range(2):
        finite = ca.logic_and(finite, ca.fabs(y[i]) <= limit)
    innovation = ca.if_else(finite, y - z, 0)
    xhat = z + ca.vertcat(0.6, 0.4) * innovation
    # The last measurement is read after its place in the memory is written: aliasing shows.
    fhat = fault + 0.1 * innovation[0] + 1e-3 * ca.if_else(finite, y[0] - y_last, 0)
    radius = ca.if_else(finite, width, ca.inf)
    root = ca.sqrt(ca.fmax(xhat, 0))
    v = ca.if_else(finite, ca.sum1(u), 0) + fhat
    z_next = xhat + 0.5 * ca.vertcat(0.8 * v - root[0], root[0] - root[1])
    ready = flag >= 0.5
    status = (
        ca.if_else(ready, 0, 1)
        + ca.if_else(finite, 0, 2)
        + ca.if_else(ca.logic_and(xhat[0] >= 1, xhat[0] <= 50), 0, 4)
        + ca.if_else(ca.fabs(innovation[1]) <= 30, 0, 8)
    )
    following = ca.vertcat(ca.if_else(finite, y[0], 0), flag, 0.5 + 0.9 * width, fhat, z_next)
    faults = [fhat, fhat - 2 * radius, fhat + 2 * radius] if n_f else [ca.SX(0, 1)] * 3
    outputs = {
        "memory": following,
        "xhat": xhat,
        "fhat": faults[0],
        "x_lower": xhat - radius,
        "x_upper": xhat + radius,
        "f_lower": faults[1],
        "f_upper": faults[2],
        "status": status,
    }
    outputs |= changes
    ports = ["memory", "u", "y"]
    named = [f"{key}_out" if key == "memory" else key for key in outputs]
    return ca.Function("step", [memory, u, y], list(outputs.values()), ports, named)


class Proved(tuple[Any, ...]):
    """Claims that can be proved again."""

    def check(self, level: str) -> Proved:
        return self


@dataclass
class Toy:
    """The part of an observer that ships."""

    step: ca.Function = field(default_factory=toy_step)
    model: ToyPlant = field(default_factory=ToyPlant)
    method: str = "toy_observer"
    precision: str = "double"
    fault_delay: int = 0
    record: Any = field(default_factory=lambda: {"design": 1})
    certificate: Proved = field(default_factory=Proved)
    memory_layout: dict[str, slice] = field(
        default_factory=lambda: {
            "y_last": slice(0, 1),
            "initialised": slice(1, 2),
            "width": slice(2, 3),
            "fault": slice(3, 4),
            "z": slice(4, 6),
        }
    )
    guarantee: SimpleNamespace = field(
        default_factory=lambda: SimpleNamespace(
            claims=("each state lies\nbetween its bounds",),
            assumptions=("|w| <= 0.1 [not monitored]", "the levels stay in range [monitored]"),
        )
    )

    def memory0(self, guess: Any, x_range: Any = None, f_range: Any = None, y0: Any = None) -> Any:
        return np.array([0.0, 1.0, 10.0, 0.0, *np.asarray(guess, dtype=float)])


@pytest.fixture
def proved() -> type[Proved]:
    return Proved


@pytest.fixture
def unbuilt(monkeypatch: pytest.MonkeyPatch) -> None:
    """Projects are written and not compiled: for tests of what is written."""
    monkeypatch.setattr("obsynth.codegen.project.find_compiler", lambda: None)


@pytest.fixture
def toy() -> Toy:
    return Toy()


@pytest.fixture(scope="session")
def make_toy() -> Callable[[], Toy]:
    return Toy


@pytest.fixture(scope="session")
def make_single() -> Callable[[], Toy]:
    """As designed for single precision: limits that are numbers of it."""
    return lambda: Toy(step=toy_step(limit=1e30), precision="single")


@pytest.fixture
def make_step() -> Callable[..., ca.Function]:
    return toy_step
