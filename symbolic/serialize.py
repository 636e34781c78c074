"""Plants as plain data for JSON, and back without evaluating anything."""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import sympy as sp

from obsynth.symbolic.discretise import PREFIX
from obsynth.symbolic.errors import PlantError
from obsynth.symbolic.signals import Role, Signal, is_name
from obsynth.symbolic.text import read_text
from obsynth.symbolic.written import write_text

if TYPE_CHECKING:
    from obsynth.symbolic.plant import Plant


FORMAT = "obsynth plant 1"
WITH_REMAINDER = "obsynth plant 2"
"""Values of ``format``; the number grows when an older reader would misunderstand."""

_REQUIRED = object()


def plant_to_dict(plant: "Plant") -> dict[str, Any]:
    """Return a complete plant as JSON-able data.

    Expressions are text, infinite bounds null, and a discretised plant is its continuous
    original with method and sampling time, so that nothing is rounded on the way.
    """
    original, formula = plant.check().continuous, plant.step
    step = None if plant.exact_Ts is None else write_text(plant.exact_Ts)
    if original is not None and formula is not None:
        how: dict[str, Any] = {"method": formula.method, "Ts": step}
        if formula.method == "taylor":
            how["order"] = formula.order
        if plant.remainder is not None:
            kept = {s.name.removeprefix(PREFIX): [s.lower, s.upper] for s in plant.remainder}
            how["remainder"] = kept
        return {
            "format": FORMAT if plant.remainder is None else WITH_REMAINDER,
            "discretise": how,
            "continuous": plant_to_dict(original),
        }
    dynamics, outputs = ([_row_text(row, plant) for row in rows] for rows in plant.equations)
    return {
        "format": FORMAT,
        "name": plant.name,
        "Ts": step,
        "signals": [signal_to_dict(signal) for signal in plant.signals],
        "dynamics": dynamics,
        "outputs": [
            {"name": name, "unit": unit, "expression": text, **_ends(*ends)}
            for name, unit, text, ends in zip(
                plant.output_names,
                plant.output_units,
                outputs,
                plant.output_ranges.tolist(),
                strict=True,
            )
        ],
    }


def check_format(data: Mapping[str, Any]) -> None:
    """Refuse data of another format."""
    stored = read_field(data, "format", str)
    step = data.get("discretise")
    kept = isinstance(step, Mapping) and "remainder" in step
    known = WITH_REMAINDER if kept else FORMAT
    if stored != known:
        raise PlantError(f"stored plant: the format is {stored!r}, this reader knows {known!r}")


def step_from_dict(data: Mapping[str, Any]) -> dict[str, Any]:
    """Read how a plant was discretised: what ``Plant.discretise`` takes."""
    kept: Any = data.get("remainder")
    if isinstance(kept, Mapping):
        kept = {name: _read_pair(name, pair) for name, pair in kept.items()}
    elif kept not in (None, False):
        raise PlantError(
            f"stored plant: the remainder is a table of ranges, not {repr(kept)[:100]}"
        )
    return {
        "method": read_field(data, "method", str),
        "Ts": read_text(read_field(data, "Ts", str), {}),
        "order": read_field(data, "order", int, None),
        "remainder": False if kept is None else kept,
    }


def _read_pair(name: str, pair: Any) -> tuple[float, float]:
    finite = isinstance(pair, list) and len(pair) == 2 and all(type(v) is float for v in pair)
    if not finite or not -math.inf < pair[0] <= pair[1] < math.inf:
        raise PlantError(
            f"stored plant: the remainder of {str(name)[:100]} is {repr(pair)[:100]}, not a range",
            symbol=str(name)[:100],
        )
    return pair[0], pair[1]


def plant_from_dict(cls: type["Plant"], data: Mapping[str, Any]) -> "Plant":
    """Read a plant from what `Plant.to_dict` returned; nothing is evaluated."""
    check_format(data)
    if "continuous" in data:
        step = step_from_dict(read_field(data, "discretise", dict))
        return plant_from_dict(cls, read_field(data, "continuous", dict)).discretise(**step)
    plant = cls(read_field(data, "name", str))
    plant.add_signals([signal_from_dict(item) for item in read_field(data, "signals", list)])
    Ts = read_field(data, "Ts", str, None)
    rows = read_field(data, "dynamics", list)
    if not all(isinstance(row, str) for row in rows):
        raise PlantError(f"stored plant: dynamics are texts, not {rows!r}", key="dynamics")
    plant.dynamics(rows, Ts=None if Ts is None else read_text(Ts, {}))
    outputs = read_field(data, "outputs", list)
    names = [_read_name(item) for item in outputs]
    units, texts = (
        [read_field(item, key, str) for item in outputs] for key in ("unit", "expression")
    )
    plant.outputs(texts, names=names, unit=units, range=[_read_ends(item) for item in outputs])
    return plant


def _row_text(row: sp.Expr, plant: "Plant") -> str:
    """Write a row, and make sure here and now that it can be read again."""
    text = write_text(row)
    if read_text(text, {signal.name: signal.symbol for signal in plant.signals}) != row:
        raise PlantError(f"the expression {row} does not survive being written as {text!r}")
    return text


def signal_to_dict(signal: Signal) -> dict[str, Any]:
    """Return a signal as JSON-able data."""
    return {
        "name": signal.name,
        "role": str(signal.role),
        **_ends(signal.lower, signal.upper),
        "unit": signal.unit,
        "nominal": signal.nominal,
        "rate": signal.rate,
        "constant": signal.constant,
        "measured": signal.measured,
        "of": signal.of,
        "value": None if signal.value is None else write_text(signal.value),
    }


def signal_from_dict(data: Any) -> Signal:
    """Read a signal back."""
    name = _read_name(data)
    role = read_field(data, "role", str)
    if role not in list(Role):
        raise PlantError(f"stored signal {name!r}: the role {role!r} is unknown", symbol=name)
    lower, upper = _read_ends(data)
    value = read_field(data, "value", str, None)
    return Signal(
        name=name,
        symbol=sp.Symbol(name, real=True),
        role=Role(role),
        lower=lower,
        upper=upper,
        unit=read_field(data, "unit", str),
        nominal=read_field(data, "nominal", float, None),
        rate=read_field(data, "rate", float, None),
        constant=read_field(data, "constant", bool),
        measured=read_field(data, "measured", bool),
        of=read_field(data, "of", str, None),
        value=None if value is None else read_text(value, {}),
    )


def _ends(lower: float, upper: float) -> dict[str, float | None]:
    """Return a range as JSON-able data, null for an infinite end."""
    pairs = {"lower": lower, "upper": upper}.items()
    return {key: value if math.isfinite(value) else None for key, value in pairs}


def _read_ends(data: Any) -> tuple[float, float]:
    lower, upper = (read_field(data, key, float, None) for key in ("lower", "upper"))
    return -math.inf if lower is None else lower, math.inf if upper is None else upper


def _read_name(data: Any) -> str:
    name: str = read_field(data, "name", str)
    if not is_name(name):
        raise PlantError(f"stored plant: {name[:100]!r} is not the name of one signal", symbol=name)
    return name


def read_field(data: Any, key: str, kind: type, default: Any = _REQUIRED) -> Any:
    """Read one field of stored data and check its type."""
    if not isinstance(data, Mapping):
        raise PlantError(f"stored plant: a table with {key!r} is needed, not {data!r}", key=key)
    value = data.get(key)
    if value is None and default is not _REQUIRED:
        return default
    if kind is float and type(value) is int and abs(value) < 2**1023:
        return float(value)
    if not isinstance(value, kind):
        raise PlantError(
            f"stored plant: {key!r} is {repr(value)[:200]}, not of type {kind.__name__}", key=key
        )
    return value
