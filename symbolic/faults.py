"""Additive faults: what they add to, and how they enter the equations."""

from collections.abc import Mapping, Sequence
from typing import Any

import sympy as sp

from obsynth.symbolic.arguments import expand_names
from obsynth.symbolic.errors import PlantError
from obsynth.symbolic.signals import Role, Signal


def read_targets(role: Role, names: Sequence[str], of: Any) -> list[str]:
    """Read ``of=``: the name of one input or output for every fault."""
    items = [of] if isinstance(of, str | sp.Symbol) else of
    if not isinstance(items, Sequence) or not all(isinstance(i, str | sp.Symbol) for i in items):
        raise PlantError(
            f"{role} {names[0]}: of= names inputs or outputs, not {of!r}", symbol=names[0]
        )
    targets = [name for item in items for name in expand_names(str(item), f"{role}: of=")]
    if len(targets) != len(names):
        raise PlantError(
            f"{role}: {len(names)} faults ({', '.join(names)}) for {len(targets)} signals in of= "
            f"({', '.join(targets)})",
            symbols=tuple(names),
            of=tuple(targets),
        )
    return targets


def fault_units(targets: Sequence[str], units: Mapping[str, str]) -> list[str]:
    """Return the units of faults, which are those of what they add to."""
    return [units.get(target, "") for target in targets]


def check_targets(signals: Sequence[Signal], outputs: Sequence[str] | None) -> None:
    """Refuse faults of what is not there, and two faults of the same signal."""
    inputs = [s.name for s in signals if s.role is Role.INPUT]
    known = {Role.ACTUATOR_FAULT: ("input", inputs), Role.SENSOR_FAULT: ("output", outputs)}
    taken: dict[tuple[Role, str], str] = {}
    for fault in signals:
        if fault.role not in known:
            continue
        word, names = known[fault.role]
        if names is not None and fault.of not in names:
            raise PlantError(
                f"{fault.role} {fault.name}: of={fault.of} is no {word}; {word}s are "
                f"{', '.join(names) or 'none yet'}",
                symbol=fault.name,
                of=fault.of,
            )
        key = (fault.role, str(fault.of))
        if key in taken:
            raise PlantError(
                f"{fault.role} {fault.name}: {fault.of} has the fault {taken[key]} already; "
                "the two could not be told apart",
                symbol=fault.name,
                of=fault.of,
            )
        taken[key] = fault.name


def insert_faults(
    rows: Sequence[sp.Expr], outputs: Mapping[str, sp.Expr], signals: Sequence[Signal]
) -> tuple[sp.Matrix, sp.Matrix]:
    """Put additive faults into the equations.

    Every input v with an actuator fault f becomes v + f, in the outputs too, since it is
    what the actuator does; every output with a sensor fault becomes y + f.
    """
    inputs = {s.name: s.symbol for s in signals if s.role is Role.INPUT}
    shift: dict[sp.Symbol, sp.Expr] = {}
    sensor: dict[str, sp.Symbol] = {}
    for signal in signals:
        if signal.role is Role.ACTUATOR_FAULT:
            shift[inputs[str(signal.of)]] = inputs[str(signal.of)] + signal.symbol
        elif signal.role is Role.SENSOR_FAULT:
            sensor[str(signal.of)] = signal.symbol
    rhs = [row.xreplace(shift) for row in rows]
    y = [row.xreplace(shift) + sensor.get(name, 0) for name, row in outputs.items()]
    return sp.ImmutableMatrix(len(rhs), 1, rhs), sp.ImmutableMatrix(len(y), 1, y)
