"""A study as a text file: a plant, how it is observed, what happens to it, what was measured.

Beside the tables of a plant (see `obsynth.symbolic.plant_file`)::

    [design]
    method = "BoundedErrorUIO"
    bounds = "peak"

    [scenario]
    steps = 500
    inputs = { v = "5 + sin(t/10)" }
    faults = { f = "piecewise((0, t < 100), (1/2, True))" }

    [record]
    file = "log.csv"
    map = { y = ["level", 0.1], v = "pump" }
"""

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
import sympy as sp

from obsynth import designs
from obsynth.designs.core.method import Method
from obsynth.designs.core.observer import Observer
from obsynth.symbolic import Plant, Record, Scenario, read_record
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.convert import to_sx
from obsynth.symbolic.plant_file import PlantText, read_text_file
from obsynth.symbolic.scenarios import gentle
from obsynth.symbolic.shown import Shown, card

_SIGNALS = {"faults": "f", "unknown_inputs": "d", "scheduling": "rho"}
_SCENARIO = {"steps", "x0", "guess", "seed", "inputs", "disturbances", *_SIGNALS}
_RECORD = {"file", "map", "time", "from", "to"}
_TIME = sp.Symbol("t", real=True)
_DEFAULT = {"method": "BoundedErrorUIO", "bounds": "peak"}
_STEPS = 1000


@dataclass(frozen=True, eq=False, repr=False)
class Study(Shown):
    """What a text file says of a plant and of what is done with it.

    Attributes
    ----------
    plant : Plant
    method : Method
        That of ``[design]``; peak bounds without one.
    """

    plant: Plant
    method: Method
    told: PlantText
    folder: Path

    def __str__(self) -> str:
        lines = [f"study of {self.plant.name} by {type(self.method).__name__}"]
        lines += [f"[{name}] is given" for name in ("scenario", "record") if name in self.told.data]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        first, *rest = str(self).splitlines()
        return card(first, rest, self.plant, self.method)

    @cached_property
    def observer(self) -> Observer:
        """The observer, designed and proved."""
        return self.method.design(self.plant)

    @property
    def model(self) -> Plant:
        """The sampled plant."""
        return self.observer.model if self.plant.Ts is None else self.plant

    @property
    def seed(self) -> int:
        """Seed of the scenario's disturbances."""
        return int(self.told.data.get("scenario", {}).get("seed", 0))

    @cached_property
    def scenario(self) -> Scenario:
        """The scenario; waves about the nominal point for what the file does not say."""
        given = self.told.data.get("scenario", {})
        self.told.known(("scenario",), given, _SCENARIO)
        plant, steps = self.model, given.get("steps", _STEPS)
        if type(steps) is not int or steps < 1:
            self.told.fail(("scenario", "steps"), f"steps is a whole number, not {steps!r}")
        if not given:
            return gentle(plant, _STEPS)
        t = np.arange(steps + 1, dtype=np.float64) * float(plant.Ts or 1.0)
        signals = {field: self._rows(field, kind, t) for field, kind in _SIGNALS.items()}
        if "disturbances" in given:
            signals["disturbances"] = self._rows("disturbances", "w", t)
        start = {name: self._state(name) for name in ("x0", "guess")}
        build: Scenario = self.told.tried(
            ("scenario",),
            Scenario,
            self.told.where,
            steps,
            inputs=self._inputs(t),
            **start,
            **signals,
        )
        return build

    def _inputs(self, t: FloatArray) -> FloatArray | Callable[[float, FloatArray], FloatArray]:
        """Return samples of the inputs, or a function of k and y where some name an output."""
        outputs = {name: sp.Symbol(name, real=True) for name in self.model.output_names}
        said = self._said("inputs", "u", outputs)
        if not said.depends_on_outputs:
            return said.samples(t)
        Ts = float(self.model.Ts or 1.0)
        return lambda k, y: np.array(said.function(Ts * k, y)).ravel()

    def _rows(self, field: str, kind: str, t: FloatArray) -> FloatArray:
        """Return samples of the signals of a kind: nominal values, or zero, where none are said."""
        return self._said(field, kind, {}).samples(t)

    def _said(self, field: str, kind: str, outputs: Mapping[str, sp.Symbol]) -> "_Said":
        """Return what is said of the signals of a kind as a function of the time and of outputs."""
        plant, path = self.model, ("scenario", field)
        given = self.told.table(path, self.told.data["scenario"].get(field, {}))
        self.told.known(path, given, plant.names(kind))
        names = {"t": _TIME, **outputs}
        said = []
        for signal in getattr(plant, kind):
            value = signal.usual if kind in ("u", "rho", "d") else 0.0
            text = given.get(signal.name, repr(value))
            said.append(self.told.expression((*path, signal.name), text, names))
        time, y = ca.SX.sym("t"), ca.SX.sym("y", len(outputs))
        symbols = {_TIME: time, **dict(zip(outputs.values(), ca.vertsplit(y), strict=True))}
        rows = ca.vertcat(*to_sx(said, symbols, plant.names(kind)))
        return _Said(ca.Function("said", [time, y], [rows]), bool(ca.depends_on(rows, y)))

    def _state(self, field: str) -> FloatArray:
        """Return x0 or the guess, nominal values where nothing is said."""
        plant, path = self.model, ("scenario", field)
        given = self.told.table(path, self.told.data["scenario"].get(field, {}))
        self.told.known(path, given, plant.names("x"))
        return np.array([float(given.get(s.name, s.usual)) for s in plant.x])

    @cached_property
    def record(self) -> Record | None:
        """What was measured, where the file names it."""
        if "record" not in self.told.data:
            return None
        given = self.told.data["record"]
        self.told.known(("record",), given, _RECORD)
        if not isinstance(given.get("file"), str):
            self.told.fail(("record",), 'a record needs file = "..."')
        columns = {
            name: tuple(spec) if isinstance(spec, list) else spec
            for name, spec in given.get("map", {}).items()
        }
        path = ("record", "file")
        file = self.folder / given["file"]
        if not file.is_file():
            self.told.fail(path, f"there is no file {given['file']!r} beside {self.told.where}")
        read: Record = self.told.tried(
            path, read_record, file, self.model, columns, given.get("time")
        )
        return read[given.get("from", 0) : given.get("to")]


class _Said(NamedTuple):
    """Signals (count,) as a function of the time in s and of the outputs (m,)."""

    function: ca.Function
    depends_on_outputs: bool

    def samples(self, t: FloatArray) -> FloatArray:
        """Return their rows (N+1, count) where no output matters."""
        y = np.zeros((self.function.size1_in(1), len(t)))
        return np.array(self.function(t[None, :], y)).reshape(-1, len(t)).T


def read_study(path: str | os.PathLike[str]) -> Study:
    """Read a plant and what is done with it from a TOML file.

    Parameters
    ----------
    path : path
        Of a plant as text, with the tables ``[design]`` (a method and its options),
        ``[scenario]`` (expressions of the time ``t`` in s; those of inputs of the outputs, too) and
        ``[record]`` where these are wanted. Files it names are beside it.

    Returns
    -------
    Study
        With ``plant``, ``observer``, ``scenario`` and ``record``, made when they are asked for.

    Raises
    ------
    PlantError
        With ``line`` and ``column`` of what cannot be read.
    """
    told = PlantText(read_text_file(path), Path(path).name)
    return Study(told.plant(), _method(told), told, Path(path).parent)


def _method(told: PlantText) -> Method:
    """Return the method of the table ``[design]`` with its options."""
    given: Mapping[str, Any] = told.data.get("design", _DEFAULT)
    known = {name: kind for name, kind in vars(designs).items() if _is_method(kind)}
    name = given.get("method", _DEFAULT["method"])
    if name not in known:
        told.fail(("design", "method"), f"{name!r} is no method; there are {', '.join(known)}")
    options = {key: _tuples(value) for key, value in given.items() if key != "method"}
    told.known(("design",), options, [field.name for field in fields(known[name])])
    method: Method = told.tried(("design",), known[name], **options)
    return method


def _is_method(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, Method) and kind is not Method


def _tuples(value: Any) -> Any:
    return tuple(_tuples(item) for item in value) if isinstance(value, list) else value
