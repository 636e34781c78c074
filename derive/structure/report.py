"""One readable report on the structure of a plant, before any design."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from obsynth.derive.equilibrium import Equilibrium
from obsynth.derive.intervals.ranges import Status
from obsynth.derive.jacobian.bounds import JacobianBounds, jacobian_bounds
from obsynth.derive.split import Split, split
from obsynth.derive.structure.conditions import (
    detectability,
    unknown_input_condition,
    weakest_member,
)
from obsynth.derive.structure.excitation import excitation
from obsynth.derive.structure.following import Following, follow
from obsynth.derive.structure.isolability import fault_isolability
from obsynth.derive.structure.zeros import (
    invariant_zeros,
    list_zeros,
    separable_faults,
    zeros_over_polytope,
)
from obsynth.symbolic.errors import ObsynthError
from obsynth.symbolic.plant import Plant
from obsynth.symbolic.shown import Shown
from obsynth.symbolic.table import Table
from obsynth.symbolic.taking import takes

T = TypeVar("T")
_MOST_VERTICES = 512


@dataclass(frozen=True)
class Check:
    """One line of a report: what was looked at, whether it passed, and what was found.

    It is None for a line that only informs, or that could not be reached.
    """

    title: str
    passed: bool | None
    text: str


@dataclass(frozen=True, eq=False, repr=False)
class StructureReport(Shown):
    """What the structure of a plant allows, line by line, in the order in which a design needs it.

    Split and Jacobian bounds stand beside the lines, where there are any.
    """

    plant: str
    checks: tuple[Check, ...]
    split: Split | None
    bounds: JacobianBounds | None

    @property
    def passed(self) -> bool:
        """True when no check failed."""
        return all(check.passed is not False for check in self.checks)

    def __getitem__(self, title: str) -> Check:
        for check in self.checks:
            if check.title == title:
                return check
        raise KeyError(title)

    def __str__(self) -> str:
        marks = {True: "ok  ", False: "FAIL", None: "    "}
        width = max(len(check.title) for check in self.checks)
        lines = [f"Structure of {self.plant}"]
        for check in self.checks:
            first, *more = check.text.split("\n")
            lines.append(f"{marks[check.passed]} {check.title:<{width}}  {first}")
            lines += [f"{'':<{width + 7}}{line}" for line in more]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        marks = {True: "\u2713", False: "\u2717", None: ""}
        rows = [(marks[check.passed], check.title, check.text) for check in self.checks]
        return Table(f"Structure of {self.plant}", ("", "", ""), rows)._repr_html_()


def _signals(model: Plant) -> str:
    kinds = (
        ("x", "states"),
        ("u", "inputs"),
        ("d", "unknown inputs"),
        ("f", "faults"),
        ("w", "disturbances"),
        ("p", "uncertain parameters"),
        ("rho", "scheduling variables"),
    )
    parts = [f"{word} {', '.join(model.names(k))}" for k, word in kinds if model.names(k)]
    parts.append(f"outputs {', '.join(model.output_names)}")
    time = "continuous time" if model.Ts is None else f"discrete time, Ts = {model.Ts:g} s"
    return "; ".join(parts) + f"; {time}"


class _Notes:
    """Collects lines; a refusal of a step becomes a failed line."""

    def __init__(self) -> None:
        self.checks: list[Check] = []

    def step(self, title: str, action: Callable[..., tuple[T, str]], *given: Any) -> T | None:
        try:
            value, text = action(*given)
        except ObsynthError as error:
            self.checks.append(Check(title, False, str(error)))
            return None
        self.checks.append(Check(title, True, text))
        return value

    def note(self, title: str, action: Callable[..., tuple[bool | None, str]], *given: Any) -> None:
        try:
            self.checks.append(Check(title, *action(*given)))
        except ObsynthError as error:
            self.checks.append(Check(title, False, str(error)))

    def inform(self, title: str, text: str) -> None:
        self.checks.append(Check(title, None, text))


@takes(model_or_split="Plant Split")
def analyse(model_or_split: Plant | Split) -> StructureReport:
    """Report on the structure of a plant; what fails is a line of the report, not an error.

    Parameters
    ----------
    model_or_split : Plant or Split
        A plant is split with ``linear="frozen"`` at its nominal equilibrium or nominal point.

    Returns
    -------
    StructureReport
        Signals, what the general class makes of a discrete plant (which faults are followed, and
        why others are not), split, point of operation, which single faults show and can be told
        apart, what has to move for that, decoupling of unknown inputs, Jacobian family,
        detectability at its vertices and inside, invariant zeros and separability of the faults.

    Examples
    --------
    >>> from obsynth.symbolic.plants import quadruple_tank
    >>> report = analyse(quadruple_tank().discretise("euler", Ts=1.0))
    >>> report.passed, report["vertices"].text.split(":")[0]
    (True, '16 (exact) in place of 64')
    """
    notes = _Notes()
    part: Split | None
    if isinstance(model_or_split, Split):
        part, model = model_or_split, model_or_split.model
        notes.inform("signals", _signals(model))
    else:
        model = model_or_split
        if notes.step("plant", lambda: (model.check(), "complete and consistent")) is None:
            return StructureReport(model.name, tuple(notes.checks), None, None)
        notes.inform("signals", _signals(model))
        general = None
        if model.Ts is not None:
            general = notes.step("general class", _follow, model)
        part = notes.step("split", _split, model)
        if part is None and general is not None:
            text = notes.checks.pop().text
            notes.inform("split", f"not of the class of the papers: {text}")
    if model.f:
        notes.note("single faults", _isolate, model)
        notes.note("excitation", lambda: (None, str(excitation(model))))
    if part is None:
        return StructureReport(model.name, tuple(notes.checks), None, None)
    _point(notes, part.at, model)
    decoupling = notes.step("unknown inputs", _decouple, part)
    bounds = notes.step("Jacobian bounds", _bounds, part)
    if bounds is None:
        return StructureReport(model.name, tuple(notes.checks), part, None)
    reasons = "\n".join(str(d) for d in bounds.dependences if d.coefficients)
    kind = "exact" if bounds.family.exact else "outer"
    text = f"{bounds.family.vertex_count} ({kind}) in place of {bounds.naive_vertex_count}"
    notes.inform("vertices", text + (f":\n{reasons}" if reasons else ""))
    if decoupling is not None:
        notes.step("detectability", _detect, part, bounds)
        _look_at_family(notes, part, bounds)
    if model.names("f"):
        _separate(notes, part, bounds)
    return StructureReport(model.name, tuple(notes.checks), part, bounds)


def _split(model: Plant) -> tuple[Split, str]:
    part = split(model)
    return part, f"linear={part.linear!r}; {part.proof}"


def _point(notes: _Notes, at: Equilibrium, model: Plant) -> None:
    values = ", ".join(f"{n} = {v:.6g}" for n, v in zip(model.names("x"), at.x, strict=True))
    inputs = ", ".join(f"{n} = {v:.6g}" for n, v in zip(model.names("u"), at.u, strict=True))
    notes.inform("point of operation", f"{values} for {inputs}; residual {at.residual:.1e}")


def _decouple(part: Split) -> tuple[bool, str]:
    found = unknown_input_condition(part)
    if found.rank == 0:
        return True, "none"
    names = ", ".join(part.model.names("d"))
    lost = [
        name for i, name in enumerate(part.model.names("x")) if np.abs(found.T[i]).max() <= 1e-12
    ]
    text = f"{names} decoupled: rank(D) = rank(C D) = {found.rank}"
    if lost:
        text += f"; {', '.join(lost)} is then taken from the measurement alone"
    return True, text


def _bounds(part: Split) -> tuple[JacobianBounds, str]:
    bounds = jacobian_bounds(part)
    worst = Status.worst(bounds.status.ravel()).word
    varying = int(bounds.varying.sum())
    words = "1 entry of dg/dx varies" if varying == 1 else f"{varying} entries of dg/dx vary"
    return bounds, f"{words}; worst status {worst}"


def _detect(part: Split, bounds: JacobianBounds) -> tuple[bool, str]:
    found = detectability(part, bounds)
    who = "state and faults are" if part.model.names("f") else "the state is"
    text = f"{who} detectable at all {found.vertices} vertices (margin {found.margin:.2g})"
    if found.hidden_modes:
        slowest = found.hidden_modes[-1]
        text += f"; a hidden mode decays with {slowest.real:.6g}"
    return True, text


def _follow(model: Plant) -> tuple[Following, str]:
    found = follow(model)
    return found, str(found)


def _isolate(model: Plant) -> tuple[bool | None, str]:
    found = fault_isolability(model)
    if not found.detectable.all():
        return False, str(found)
    return (True if len(found.unique) == len(found.faults) else None), str(found)


def _look_at_family(notes: _Notes, part: Split, bounds: JacobianBounds) -> None:
    """Zeros at the vertices of the Jacobian family, and its weakest member."""
    count = bounds.family.vertex_count
    if count > _MOST_VERTICES:
        notes.inform("zeros at vertices", f"not looked at: the family has {count} vertices")
        return
    if part.model.d:
        notes.note("zeros of unknown inputs", _unknown_zeros, part, bounds)
    if part.model.f:
        notes.note(
            "zeros with faults", lambda: (None, str(zeros_over_polytope(part, bounds, "all")))
        )
    if count > 1:
        notes.note("weakest member", lambda: (None, str(weakest_member(part, bounds))))


def _unknown_zeros(part: Split, bounds: JacobianBounds) -> tuple[bool, str]:
    found = zeros_over_polytope(part, bounds, "unknown")
    return found.decays, str(found)


def _separate(notes: _Notes, part: Split, bounds: JacobianBounds) -> None:
    apart, rank, signals = separable_faults(part, bounds.family.midpoint)
    names = part.model.names("f")
    if signals <= len(part.C):
        listed = list_zeros(invariant_zeros(part, bounds.family.midpoint))
        notes.inform("invariant zeros", listed or "none, from faults and unknown inputs to outputs")
    if len(apart) == len(names):
        text = f"{', '.join(names)} can be told apart (rank {rank} of {signals})"
        notes.checks.append(Check("faults", True, text))
        return
    mixed = ", ".join(n for n in names if n not in apart)
    others = " and from unknown inputs" if part.model.names("d") else ""
    text = f"{mixed} cannot be told apart from other faults{others} (rank {rank} of {signals})"
    notes.checks.append(Check("faults", False, text))
