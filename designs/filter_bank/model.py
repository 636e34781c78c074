"""What the bank reads of a plant: signs of slopes, what outputs show, where faults enter."""

from typing import Any

import numpy as np
import sympy as sp
from numpy.typing import ArrayLike

from obsynth.derive import Split, StructureError
from obsynth.derive.algebra.sizes import text
from obsynth.derive.forms.scheduling import Reading, readings
from obsynth.derive.jacobian.slope_signs import Monotone, exact_slope, with_ranges
from obsynth.derive.rigour import round_number, substitute
from obsynth.designs.core.given import PlantClass
from obsynth.designs.filter_bank.record import UNKNOWN, BankModel, Signs
from obsynth.symbolic import Plant, Signal
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError

_NO_RANGE = " has no range; declare it with range="
CLASS = PlantClass(
    who="the bank of filters",
    time="continuous",
    discretised=True,
    forbids={
        "d": ": the bank decouples none; declare one with a range as a disturbance, or as a fault",
    },
    finite={"f": _NO_RANGE, "w": _NO_RANGE, "p": _NO_RANGE},
    needs={"f": "the bank bounds faults"},
)


def read(given: Plant | Split, region: ArrayLike | None = None) -> BankModel:
    """Derive everything that the bank rests on, or refuse the plant by name."""
    plant = CLASS.check(given if isinstance(given, Plant) else given.model)
    plant.check()
    for signal in _unknown(plant, "rho"):
        if not signal.bounded:
            raise StructureError(
                f"the {signal.role} {signal.name}{_NO_RANGE}",
                symbol=signal.name,
                condition="bounded signals",
            )
    box = _read_region(plant, region)
    shown = _readings(plant)
    names = plant.names("x")
    outputs = [names.index(str(item.state)) for item in shown]
    values = plant.constant_values
    rhs = [sp.expand(substitute(row, values)) for row in plant.rhs]
    fault_rows, gain = _faults(plant, rhs, outputs)
    signs = _signs(plant, box)
    for i, name in enumerate(names):
        if i not in outputs and signs.x[i, i] > 0:
            raise StructureError(
                f"the derivative of {name} rises with {name} itself; the bank needs unmeasured "
                "states whose own flow falls: measure it",
                symbol=name,
                condition="falling own flow",
            )
    return BankModel(
        plant=plant,
        region=box,
        outputs=np.array(outputs, dtype=np.int64),
        scale=np.array([round_number(r.scale)[0] for r in shown]),
        noise=np.array([_noise(plant, r) for r in shown]).reshape(-1, 2),
        fault_rows=np.array(fault_rows, dtype=np.int64),
        gain=np.array(gain),
        signs=signs,
    )


def read_again(design: BankModel) -> BankModel:
    """Derive it from the stored equations, over the stored region."""
    return read(design.plant, design.region)


def _unknown(plant: Plant, kind: str) -> list[Signal]:
    """Return the signals of a kind that are not known at run time."""
    return [s for s in getattr(plant, kind) if kind != "rho" or not s.measured]


def _read_region(plant: Plant, region: ArrayLike | None) -> FloatArray:
    loose = tuple(s.name for s in plant.x if not s.bounded)
    if region is None and loose:
        raise StructureError(
            f"state {', '.join(loose)} has no range, and the bank begins anew from ranges and "
            "counts its rounding by them, also in states that enter linearly; declare it with "
            "range=, or give region=",
            symbol=loose[0],
            symbols=loose,
            condition="states with ranges",
        )
    box = plant.box("x") if region is None else np.array(region, dtype=float)
    if box.shape != (len(plant.x), 2) or not np.isfinite(box).all():
        raise ObsynthError(
            f"region has to be {len(plant.x)} finite pairs ({', '.join(plant.names('x'))})",
            option="region",
        )
    return box


def _signs(plant: Plant, region: FloatArray) -> Signs:
    monotone = Monotone(with_ranges(plant, region))
    tables: dict[str, Any] = {}
    for kind in UNKNOWN:
        table = np.zeros((len(plant.x), len(getattr(plant, kind))), dtype=np.int64)
        unknown = _unknown(plant, kind)
        columns = [getattr(plant, kind).index(signal) for signal in unknown]
        for i, row in enumerate(table):
            row[columns] = monotone.signs(i, unknown)
        tables[kind] = table
    return Signs(**tables)


def _readings(plant: Plant) -> tuple[Reading, ...]:
    shown = readings(plant)
    told = {item.output for item in shown}
    for name in plant.output_names:
        if name not in told:
            raise StructureError(
                f"the output {name} does not show a single state of its own, free of faults; the "
                "bank needs outputs that do",
                symbol=name,
                condition="outputs show states",
            )
    for item in shown:
        if not item.scale.is_positive:
            raise StructureError(
                f"the output {item.output} falls with {item.state}; measure its negative",
                symbol=item.output,
                condition="outputs rise with their states",
            )
    return shown


def _faults(plant: Plant, rhs: list[sp.Expr], outputs: list[int]) -> tuple[list[int], list[float]]:
    rows: list[int] = []
    gains: list[float] = []
    names = plant.names("x")
    for fault in plant.f:
        entered = [i for i, row in enumerate(rhs) if row.has(fault.symbol)]
        for i in entered:
            if i not in outputs:
                raise StructureError(
                    f"the fault {fault.name} enters the equation of {names[i]}, which is not "
                    "measured; the bank encloses unmeasured states whatever the faults do, so "
                    f"measure {names[i]} or use SetAdaptiveObserver",
                    symbol=fault.name,
                    row=names[i],
                    condition="faults in measured states only",
                )
        if len(entered) != 1:
            raise StructureError(
                f"the fault {fault.name} enters {len(entered)} equations; the bank needs one for "
                "each fault",
                symbol=fault.name,
                condition="one equation for each fault",
            )
        slope = exact_slope(rhs[entered[0]], fault.symbol)
        if not slope.is_number or slope.is_zero:
            raise StructureError(
                f"the fault {fault.name} enters the equation of {names[entered[0]]} with the "
                f"factor {text(slope)}; the bank needs a constant",
                symbol=fault.name,
                condition="constant factors",
            )
        if entered[0] in rows:
            other = plant.f[rows.index(entered[0])].name
            raise StructureError(
                f"the faults {other} and {fault.name} enter the same equation "
                f"({names[entered[0]]}) and cannot be told apart: declare one of them",
                symbol=fault.name,
                condition="one fault in each equation",
            )
        rows.append(entered[0])
        gains.append(round_number(slope)[0])
    return rows, gains


def _noise(plant: Plant, item: Reading) -> tuple[float, float]:
    bounds = {s.symbol: s for s in plant.w}
    low, high = 0.0, 0.0
    for symbol, factor in item.noise:
        ends = sorted(float(factor) * end for end in (bounds[symbol].lower, bounds[symbol].upper))
        low, high = low + ends[0], high + ends[1]
    ulp = 2.0**-50
    return low - ulp * abs(low), high + ulp * abs(high)
