"""The robust bank: which plants it is for, and what is stored of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import sympy as sp
from numpy.typing import NDArray

from obsynth.derive import Split, StructureError
from obsynth.derive.forms.measured import Reading, readings
from obsynth.derive.jacobian.slope_signs import Monotone, exact_slope, with_ranges
from obsynth.derive.rigour import round_number, substitute
from obsynth.designs.core.errors import CertificateError
from obsynth.designs.core.record import plain_fields, read_array, reading
from obsynth.designs.set_adaptive.model import continuous
from obsynth.designs.set_adaptive.transition import PRECISIONS, allowance
from obsynth.symbolic import Plant, Signal
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError

if TYPE_CHECKING:
    from obsynth.designs.set_adaptive.method import SetAdaptiveObserver


Integers = NDArray[np.int64]
UNKNOWN = ("x", "w", "p", "rho", "f")
"""Kinds of signals that are not known at run time, besides measured scheduling variables."""
_DEFAULT_TS = 0.01


@dataclass(frozen=True, eq=False)
class BankDesign:
    """Everything that is deployed and proved of the bank.

    plant: continuous
    region (n, 2): where the equations are monotone, and where the states are assumed to be
    outputs (m,): which state each output shows
    scale (m,)
    noise (m, 2): range of what is added to scale * state
    fault_rows (q,): the state that each fault enters
    gain (q,)
    signs (n, number of signals): signs of the slopes of the equations, by the kinds of `UNKNOWN`
    filters (l,)
    """

    plant: Plant
    Ts: float
    region: FloatArray
    outputs: Integers
    scale: FloatArray
    noise: FloatArray
    fault_rows: Integers
    gain: FloatArray
    signs: Mapping[str, Integers]
    filters: FloatArray
    options: Mapping[str, Any]

    @property
    def precision(self) -> str:
        """``"double"`` or ``"single"``."""
        return str(self.options.get("precision", "double"))

    @property
    def rounding(self) -> float:
        """What the rounding of one step may be, relative to the size of its terms."""
        return allowance(self.precision, len(self.plant.x))

    @property
    def hidden(self) -> list[int]:
        """States that no output shows."""
        return [i for i in range(len(self.plant.x)) if i not in set(self.outputs.tolist())]

    def to_record(self) -> dict[str, Any]:
        """Return the design as JSON-able data."""
        return {"kind": "bank", **plain_fields(self)}

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> BankDesign:
        """Read and check the data of `to_record`."""
        with reading():
            plant = Plant.from_dict(record["plant"])
            n, m, q = len(plant.x), len(plant.output), len(plant.f)
            shapes = {kind: (n, len(getattr(plant, kind))) for kind in UNKNOWN}
            design = cls(
                plant=plant,
                Ts=float(record["Ts"]),
                region=read_array(record["region"], (n, 2), "region"),
                outputs=_integers(record["outputs"], (m,), n),
                scale=read_array(record["scale"], (m,), "scale"),
                noise=read_array(record["noise"], (m, 2), "noise"),
                fault_rows=_integers(record["fault_rows"], (q,), n),
                gain=read_array(record["gain"], (q,), "gain"),
                signs={
                    kind: np.asarray(record["signs"][kind], dtype=np.int64).reshape(shapes[kind])
                    for kind in UNKNOWN
                },
                filters=read_array(record["filters"], (len(record["filters"]),), "filters"),
                options=dict(record["options"]),
            )
        if design.precision not in PRECISIONS:
            raise CertificateError(f"precision = {design.precision!r} in the stored design")
        return design


def design_bank(model: Plant | Split, method: SetAdaptiveObserver) -> BankDesign:
    """Read a plant for the bank, or refuse it by name."""
    plant = continuous(model)
    region = plant.box("x") if method.region is None else np.asarray(method.region, dtype=float)
    if region.shape != (len(plant.x), 2) or not np.isfinite(region).all():
        raise ObsynthError(
            f"region has to be {len(plant.x)} finite pairs ({', '.join(plant.names('x'))})",
            option="region",
        )
    options = asdict(method)
    options["filters"] = list(method.filters)
    options["region"] = region.tolist()
    options["Gamma"] = None
    Ts = _DEFAULT_TS if method.Ts is None else float(method.Ts)
    return read_bank(plant, region, Ts, np.array(method.filters), options)


def read_bank(
    plant: Plant,
    region: FloatArray,
    Ts: float,
    filters: FloatArray,
    options: Mapping[str, Any],
) -> BankDesign:
    """Derive everything that the bank rests on from the equations."""
    _check_plant(plant)
    shown = _readings(plant)
    outputs = [plant.names("x").index(str(item.state)) for item in shown]
    values = plant.constant_values
    rhs = [sp.expand(substitute(row, values)) for row in plant.rhs]
    fault_rows, gain = _faults(plant, rhs, outputs)
    monotone = Monotone(with_ranges(plant, region))
    signs = {
        kind: np.zeros((len(plant.x), len(getattr(plant, kind))), dtype=np.int64)
        for kind in UNKNOWN
    }
    for kind, table in signs.items():
        unknown = unknown_signals(plant, kind)
        columns = [getattr(plant, kind).index(signal) for signal in unknown]
        for i in range(len(plant.x)):
            table[i, columns] = monotone.signs(i, unknown)
    for i in range(len(plant.x)):
        if i not in outputs and signs["x"][i, i] > 0:
            raise StructureError(
                f"the derivative of {plant.names('x')[i]} rises with {plant.names('x')[i]} itself; "
                "the bank needs unmeasured states whose own flow falls: measure it",
                symbol=plant.names("x")[i],
                condition="falling own flow",
            )
    return BankDesign(
        plant=plant,
        Ts=Ts,
        region=region,
        outputs=np.array(outputs, dtype=np.int64),
        scale=np.array([round_number(r.scale)[0] for r in shown]),
        noise=np.array([_noise(plant, r) for r in shown]).reshape(-1, 2),
        fault_rows=np.array(fault_rows, dtype=np.int64),
        gain=np.array(gain),
        signs=signs,
        filters=filters,
        options=options,
    )


def unknown_signals(plant: Plant, kind: str) -> list[Signal]:
    """Return the signals of a kind that are not known at run time."""
    return [s for s in getattr(plant, kind) if kind != "rho" or not s.measured]


def _check_plant(plant: Plant) -> None:
    plant.check()
    if plant.d:
        raise StructureError(
            f"the unknown input {plant.d[0].name} has no bound that the bank could use; declare it "
            "as a disturbance with bound=, or as a fault",
            symbol=plant.d[0].name,
            condition="no unknown inputs",
        )
    if not plant.f:
        raise StructureError(
            f"{plant.name!r} declares no fault", symbol=plant.name, condition="faults"
        )
    for kind in ("f", "w", "p", "rho"):
        for signal in unknown_signals(plant, kind):
            if not signal.bounded:
                raise StructureError(
                    f"the {signal.role} {signal.name} has no range; declare it with range=",
                    symbol=signal.name,
                    condition="bounded signals",
                )


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
                    f"measure {names[i]} or use the observer without robust=True",
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
        if not slope.is_number or not slope > 0:
            raise StructureError(
                f"the fault {fault.name} enters the equation of {names[entered[0]]} with the "
                f"factor {slope}; the bank needs a positive constant",
                symbol=fault.name,
                condition="constant positive factors",
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


def _integers(value: Any, shape: tuple[int, ...], end: int) -> Integers:
    array = np.asarray(value, dtype=np.int64)
    if array.shape != shape or np.any(array < 0) or np.any(array >= end):
        raise ValueError(f"{value!r} are not {shape} numbers of states")
    return array
