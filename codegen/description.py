"""What a project is made from: an observer, checked and with C names."""

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from obsynth.codegen.errors import CodegenError
from obsynth.codegen.kernel import DOUBLE, REALS, STEP_INPUTS, Machine, Real
from obsynth.codegen.names import project_name, unique
from obsynth.derive.equilibrium import operating_values
from obsynth.designs.core.files import stored_text
from obsynth.designs.core.observer import FURTHER_OUTPUTS, STEP_OUTPUTS, Observer
from obsynth.designs.detection.detector import FaultDetector
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray


@dataclass(frozen=True)
class Field:
    """A member of the state: a named slice of the memory."""

    name: str
    start: int
    size: int


@dataclass(frozen=True)
class Port:
    """A signal as the header shows it: C name, the user's name, unit and declared range."""

    c_name: str
    name: str
    unit: str = ""
    lower: float = -math.inf
    upper: float = math.inf

    def __str__(self) -> str:
        unit = f" [{self.unit}]" if self.unit else ""
        if math.isinf(self.lower) and math.isinf(self.upper):
            return f"{self.name}{unit}"
        return f"{self.name}{unit}, declared range {self.lower:.6g} to {self.upper:.6g}"


@dataclass(frozen=True, eq=False)
class Description:
    """An observer as the templates see it, with C names.

    theta: the measured scheduling signals; empty where the step does not read them
    scheduling: their places among all scheduling signals of the plant
    start (n_memory,): the initialised memory that ``NAME_init_default`` sets
    model_hash, design_hash, certificate_hash: SHA-256 of the plant's stored form, of the record of
        the design with the options of a detector, of the claims without margins, whose last digits
        are the machine's
    design: the stored design, as `Observer.save` writes it
    claims: names of what is proved, from the stored equations on
    real: the type that the step computes in
    """

    name: str
    observer: Observer | FaultDetector
    sample_time: float
    fields: tuple[Field, ...]
    x: tuple[Port, ...]
    u: tuple[Port, ...]
    y: tuple[Port, ...]
    f: tuple[Port, ...]
    theta: tuple[Port, ...]
    scheduling: tuple[int, ...]
    start: FloatArray
    model_hash: str
    design: str
    detector: Mapping[str, Any]
    design_hash: str
    certificate_hash: str
    claims: tuple[str, ...]
    real: Real

    @property
    def further(self) -> list[tuple[str, int]]:
        """What a fault detector's step has behind the observer's outputs, with the lengths."""
        step = self.observer.step
        places = range(len(STEP_OUTPUTS), step.n_out())
        return [(step.name_out(i), int(step.numel_out(i))) for i in places]

    @property
    def outputs(self) -> list[tuple[str, int]]:
        """The results of a step beside memory and status, with their lengths."""
        ends = [(f"{kind}_{end}", kind) for kind in "xf" for end in ("lower", "upper")]
        names = [("xhat", "x"), ("fhat", "f"), *ends]
        return [(name, self.sizes[kind]) for name, kind in names] + self.further

    @property
    def sizes(self) -> dict[str, int]:
        """Lengths of the vectors; that of theta where the observer is scheduled."""
        theta = {"theta": len(self.theta)} if self.theta else {}
        return {
            "memory": int(self.start.size),
            "u": len(self.u),
            "y": len(self.y),
            **theta,
            "x": len(self.x),
            "f": len(self.f),
        }

    def split(self, inputs: FloatArray) -> list[FloatArray]:
        """Return u, y and theta where there is one, of one vector."""
        sizes = [self.sizes.get(kind, 0) for kind in STEP_INPUTS[1:]]
        parts = np.split(inputs.astype(float), np.cumsum(sizes)[:-1])
        return parts if self.theta else parts[:-1]

    def place(self, port: str, i: int) -> str:
        """Return what entry i of a vector of the step is called in C, between its structs."""
        if port in {"memory", "next"}:
            field = next(f for f in self.fields if f.start <= i < f.start + f.size)
            return f"state->{field.name}" + (f"[{i - field.start}]" if field.size > 1 else "")
        return f"{'in' if port in STEP_INPUTS else 'out'}->{port}[{i}]"


def describe(
    observer: Observer | FaultDetector,
    name: str | None = None,
    memory: FloatArray | None = None,
    precision: str | None = None,
) -> Description:
    """Check that an observer can ship and collect what its C project says of it.

    Shapes: memory (n_memory,).
    """
    model = observer.model
    if model.Ts is None:
        raise CodegenError(
            f"{model.name!r} has no sample time, so its observer has no step to ship; design the"
            " observer for plant.discretise(...) or give dynamics(..., Ts=...)",
            symbol=model.name,
        )
    sample_time = float(model.Ts)
    if not 0 < sample_time < math.inf:
        raise CodegenError(f"the sample time of {model.name!r} is {sample_time}", symbol=model.name)
    if observer.fault_delay not in (0, 1):
        raise CodegenError(
            f"fault_delay is {observer.fault_delay!r}; 0 and 1 are the delays a step can have"
        )
    chosen = project_name(name, model.name)
    fields = _fields(observer.memory_layout)
    n_memory = fields[-1].start + fields[-1].size
    scheduling = _scheduling(observer.step, model)
    _check_step(observer.step, model, n_memory, len(scheduling))
    inner, options = _taken_apart(observer)
    # loading a design proves less than designing it: what ships is proved
    inner = replace(inner, certificate=inner.certificate.check("full"))
    real = _real(inner, precision)
    start = np.array([real.rounded(v) for v in _start(observer, memory, n_memory).tolist()])
    _check_not_initialised(observer)
    return Description(
        name=chosen,
        observer=observer,
        sample_time=sample_time,
        fields=fields,
        x=_ports(model, "x"),
        u=_ports(model, "u"),
        y=_measurements(model),
        f=_ports(model, "f"),
        theta=tuple(_ports(model, "rho")[i] for i in scheduling) if scheduling else (),
        scheduling=scheduling,
        start=start,
        model_hash=_hash(model.to_dict()),
        design=stored_text(inner),
        detector=options,
        design_hash=_hash({"record": inner.record, "detector": options}),
        certificate_hash=_hash(
            {"claims": [[c.name, c.statement, c.holds] for c in inner.certificate]}
        ),
        claims=tuple(claim.name for claim in inner.certificate),
        real=real,
    )


def _real(observer: Observer, precision: str | None) -> Real:
    """Return the type of a step: the design's, or double, which never rounds more."""
    designed = observer.precision
    real = REALS[designed if precision is None else precision]
    if real is not DOUBLE and real.precision != designed:
        raise CodegenError(
            f"precision={precision!r}, but {observer.method} was designed for {designed} precision,"
            f" and its bounds do not count what rounding adds in {precision}: design it with"
            f" precision={precision!r}",
            precision=precision,
        )
    return real


def _taken_apart(observer: Observer | FaultDetector) -> tuple[Observer, dict[str, Any]]:
    """Return the observer that is stored, and what a detector adds to it."""
    if not isinstance(observer, FaultDetector):
        return observer, {}
    names = ("persistence", "also_skip", "window")
    return observer.observer, {name: getattr(observer, name) for name in names}


def _fields(layout: Mapping[str, slice]) -> tuple[Field, ...]:
    ordered = sorted(layout.items(), key=lambda item: item[1].start or 0)
    names = unique(key for key, _ in ordered)
    fields, end = [], 0
    for (key, part), name in zip(ordered, names, strict=True):
        start, stop = part.start or 0, part.stop
        if start != end or stop is None or stop < start or part.step not in (None, 1):
            raise CodegenError(
                f"memory_layout[{key!r}] is {part}, but the entries before it end at {end}: the"
                " layout has to cover the memory without gaps and overlaps",
                symbol=key,
            )
        end = stop
        if stop > start:
            fields.append(Field(name, start, stop - start))
    if not fields:
        raise CodegenError("memory_layout is empty: the observer has no memory to carry along")
    return tuple(fields)


def _scheduling(step: ca.Function, model: Plant) -> tuple[int, ...]:
    """Return the places of the scheduling signals that a step reads as theta."""
    if STEP_INPUTS[-1] not in step.name_in():
        return ()
    return tuple(i for i, signal in enumerate(model.rho) if signal.measured)


def _check_step(step: ca.Function, model: Plant, n_memory: int, n_theta: int) -> None:
    """Refuse a step that takes or returns other numbers than its plant and memory have."""
    n, n_f = len(model.x), len(model.f)
    behind = tuple(step.name_out()[len(STEP_OUTPUTS) :])
    behind = behind if behind in FURTHER_OUTPUTS else ()
    takes = dict(zip(STEP_INPUTS, (n_memory, len(model.u), len(model.output_names)), strict=False))
    takes |= {STEP_INPUTS[-1]: n_theta} if n_theta else {}
    gives = dict(zip(STEP_OUTPUTS, (n_memory, n, n_f, n, n, n_f, n_f, 1), strict=True))
    gives |= dict(zip(behind, (n_f, n_f, n_f, 1), strict=False))
    found_in = [step.numel_in(i) for i in range(step.n_in())]
    found_out = [step.numel_out(i) for i in range(step.n_out())]
    for word, wanted, found in (("takes", takes, found_in), ("returns", gives, found_out)):
        if found != [*wanted.values()]:
            told = ", ".join(f"{name} ({size})" for name, size in wanted.items())
            raise CodegenError(
                f"the step {word} vectors of {found} numbers; the plant {model.name!r} and the"
                f" memory layout ask for {told}",
                found=found,
                expected=wanted,
            )


def midpoints(model: Plant, kind: str) -> FloatArray:
    """Return the middle of every range; zero without one."""
    return np.array([s.middle for s in getattr(model, kind)], dtype=float)


def _start(
    observer: Observer | FaultDetector, memory: FloatArray | None, n_memory: int
) -> FloatArray:
    given = "memory=" if memory is not None else "what memory0 returned"
    value = observer.memory0(operating_values(observer.model, "x")) if memory is None else memory
    start = np.array(value, dtype=float)
    if start.shape != (n_memory,):
        raise CodegenError(
            f"{given} has shape {start.shape}; the layout of the memory asks for ({n_memory},)",
            symbol="memory",
        )
    return start


def _check_not_initialised(observer: Observer | FaultDetector) -> None:
    """Make sure that a state nobody has initialised is told apart by the step itself."""
    zeros = [np.zeros(observer.step.numel_in(i)) for i in range(observer.step.n_in())]
    status = float(Machine(observer.step)(*zeros)[STEP_OUTPUTS.index("status")][0])
    if not (status.is_integer() and int(status) & 1):
        raise CodegenError(
            f"the step returns status {status:g} for a memory of zeros; bit 1 (not initialised)"
            " has to be set there, since zeros are what a C program holds before it calls init",
            status=status,
        )


def _ports(model: Plant, kind: str) -> tuple[Port, ...]:
    signals = getattr(model, kind)
    box = np.asarray(model.box(kind), dtype=float).reshape(-1, 2)
    names = unique(signal.name for signal in signals)
    return tuple(
        Port(c_name, signal.name, signal.unit, float(lower), float(upper))
        for c_name, signal, (lower, upper) in zip(names, signals, box, strict=True)
    )


def _measurements(model: Plant) -> tuple[Port, ...]:
    names = tuple(model.output_names)
    return tuple(
        Port(c_name, name, unit)
        for c_name, name, unit in zip(unique(names), names, model.output_units, strict=True)
    )


def _hash(data: Mapping[str, Any]) -> str:
    text = json.dumps(data, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()
