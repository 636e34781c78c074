"""The signals of a plant, by name and by kind; what its faults add to."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import sympy as sp
from numpy.typing import NDArray

from obsynth.symbolic.errors import PlantError
from obsynth.symbolic.signals import KINDS, Role, Signal, exact_number, expand_names, make_signals
from obsynth.symbolic.taking import Symbols
from obsynth.symbolic.ufuncs import allow


class SignalTable:
    """Signals in order of declaration, each name once.

    signals: the first ones
    """

    def __init__(self, signals: Sequence[Signal] = ()) -> None:
        self._signals: dict[str, Signal] = {}
        self.add(signals)

    @property
    def all(self) -> tuple[Signal, ...]:
        """All signals in order of declaration."""
        return tuple(self._signals.values())

    @property
    def symbols(self) -> dict[str, sp.Symbol]:
        """The symbols by name."""
        return {name: signal.symbol for name, signal in self._signals.items()}

    @property
    def constants(self) -> tuple[Signal, ...]:
        """Parameters with a plain value."""
        return tuple(s for s in self.all if s.role is Role.PARAM and s.lower == s.upper)

    @property
    def constant_values(self) -> dict[sp.Symbol, sp.Expr]:
        """Exact value of every constant."""
        return {
            signal.symbol: exact_number(signal.lower, signal.name)
            if signal.value is None
            else signal.value
            for signal in self.constants
        }

    def kind(self, kind: str) -> tuple[Signal, ...]:
        """Return the signals of a kind; ``"p"`` leaves out the constants."""
        if kind not in KINDS:
            raise PlantError(f"{kind!r} is no kind of signal; kinds are {', '.join(KINDS)}")
        found = tuple(signal for signal in self.all if signal.role in KINDS[kind])
        return tuple(s for s in found if s.lower < s.upper) if kind == "p" else found

    def names(self, kind: str) -> tuple[str, ...]:
        """Return the names of a kind."""
        return tuple(signal.name for signal in self.kind(kind))

    def box(self, kind: str) -> NDArray[np.float64]:
        """Return the bounds of a kind, shape (number, 2)."""
        rows = [(signal.lower, signal.upper) for signal in self.kind(kind)]
        return np.array(rows, dtype=np.float64).reshape(len(rows), 2)

    def declare(
        self, role: Role, names: Any, taken: Sequence[str] = (), **keywords: Any
    ) -> tuple[sp.Symbol, ...]:
        """Make signals from the arguments of a declaration and add them."""
        allow()
        signals = make_signals(role, names, **keywords)
        self.add(signals, taken)
        return Symbols(signal.symbol for signal in signals)

    def declare_faults(
        self, role: Role, names: Any, of: Any, outputs: Mapping[str, str], **keywords: Any
    ) -> tuple[sp.Symbol, ...]:
        """Declare faults that add to inputs or outputs, with the units of these."""
        targets = _read_targets(role, expand_names(names, str(role)), of)
        if keywords.get("unit") is None:
            inputs = {signal.name: signal.unit for signal in self.kind("u")}
            units = inputs if role is Role.ACTUATOR_FAULT else outputs
            keywords["unit"] = [units.get(target, "") for target in targets]
        return self.declare(role, names, tuple(outputs), of=targets, **keywords)

    def add(self, signals: Sequence[Signal], outputs: Sequence[str] = ()) -> None:
        """Add signals, all of them or none."""
        added: dict[str, Signal] = {}
        for signal in signals:
            taken = self._signals.get(signal.name) or added.get(signal.name)
            if taken is not None or signal.name in outputs:
                role = "output" if taken is None else str(taken.role)
                raise PlantError(
                    f"{signal.role} {signal.name}: the name is taken by the {role} {signal.name}",
                    symbol=signal.name,
                )
            added[signal.name] = signal
        check_targets([*self.all, *signals], outputs or None)
        self._signals.update(added)


def _read_targets(role: Role, names: Sequence[str], of: Any) -> list[str]:
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
