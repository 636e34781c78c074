"""The class of plants that a method is for, as data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from obsynth.derive.errors import StructureError
from obsynth.symbolic import Plant, Role

WORDS = {
    "d": "unknown input",
    "p": "parameter",
    "rho": "scheduling variable",
    "x": "state",
    "u": "input",
    "w": "disturbance",
    "f": "fault",
}
"""Kinds of signals as refusals call them."""


@dataclass(frozen=True)
class PlantClass:
    """What a plant has to be for a method; each refusal is a clause after the symbols' names.

    who: the method as a refusal calls it, "the bounded-error observer"
    time: in which the method works
    discretised: whether a discretisation stands for the continuous plant that it was made from
    forbids: kind of signal -> why the method has none of it and what to do instead
    finite: kind of signal -> why each of it needs a finite range and how to declare it
    needs: kind of signal -> why at least one is needed
    faults: roles of the faults that the method estimates
    """

    who: str
    time: Literal["discrete", "continuous"]
    discretised: bool = False
    forbids: Mapping[str, str] = field(default_factory=dict)
    finite: Mapping[str, str] = field(default_factory=dict)
    needs: Mapping[str, str] = field(default_factory=dict)
    faults: tuple[Role, ...] = (Role.ACTUATOR_FAULT, Role.PROCESS_FAULT)

    def check(self, plant: Plant) -> Plant:
        """Return the plant in the method's time, or refuse it by the user's own names."""
        plant = self._in_time(plant)
        for kind, clause in self.forbids.items():
            self._refuse(kind, plant.names(kind), clause)
        sensors = [s.name for s in plant.f if s.role not in self.faults]
        if sensors:
            raise StructureError(
                f"sensor fault {', '.join(sensors)}: this method estimates faults that enter the "
                "dynamics (actuator and process faults)",
                symbols=tuple(sensors),
                condition="faults in the dynamics",
            )
        for kind, clause in self.finite.items():
            loose = tuple(s.name for s in getattr(plant, kind) if not s.bounded)
            self._refuse(kind, loose, clause)
        for kind, clause in self.needs.items():
            if not getattr(plant, kind):
                raise StructureError(
                    f"{plant.name!r} declares no {WORDS[kind]}; {clause}",
                    symbol=plant.name,
                    condition=f"at least one {WORDS[kind]}",
                )
        return plant

    def _in_time(self, plant: Plant) -> Plant:
        if self.time == "continuous":
            behind = plant.continuous if self.discretised and plant.Ts is not None else plant
            if behind is None or behind.Ts is not None:
                raise StructureError(
                    f"{plant.name!r} is a discrete plant and {self.who} does not work in discrete "
                    "time: give the continuous plant, and Ts= of the observer for the sampling of "
                    "its step",
                    symbol=plant.name,
                    condition="continuous time",
                )
            return behind
        if plant.Ts is None:
            raise StructureError(
                f"{plant.name} is in continuous time and {self.who} works in discrete time: "
                'call discretise("euler", Ts=...) first',
                condition="discrete time",
            )
        return plant

    @staticmethod
    def _refuse(kind: str, names: tuple[str, ...], clause: str) -> None:
        if names:
            raise StructureError(
                f"{WORDS[kind]} {', '.join(names)}{clause}",
                symbols=names,
                symbol=names[0],
                condition=f"{WORDS[kind]}s",
            )
