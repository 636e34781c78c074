"""`generate_fmu`: a unit for co-simulation (FMI 2.0) of one observer step."""

import hashlib
import math
import platform
import sys
import uuid
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

from numpy.typing import ArrayLike

from obsynth.codegen.build import Build, Comparison
from obsynth.codegen.description import Description, Port, describe
from obsynth.codegen.errors import CodegenError
from obsynth.codegen.project import compared, write_step
from obsynth.codegen.render import fill, render, template_values
from obsynth.codegen.start import Start, Variable, start_of
from obsynth.designs.core.files import replaced
from obsynth.designs.core.observer import ALARM_OUTPUT, STATUS, STEP_OUTPUTS, Observer
from obsynth.designs.detection.detector import FaultDetector
from obsynth.symbolic.table import Table, Tabled
from obsynth.symbolic.taking import takes

_PLATFORMS = {("linux", "x86_64"): ("linux64", "so"), ("darwin", "x86_64"): ("darwin64", "dylib")}
_FLAGS = ("-O2", "-fPIC", "-fvisibility=hidden")
_DESCRIPTION = "modelDescription.xml"
_RANKS = ("parameter", "input", "Real", "Boolean", "Integer")
_ORDER = ("input", "output", "parameter")
_INPUTS = {"u": "input", "y": "measurement (NaN: missing)", "theta": "scheduling signal"}
_OUTPUTS = {
    "xhat": ("hat", "estimate of", 0.0),
    "x_lower": ("lower", "lower bound of", -math.inf),
    "x_upper": ("upper", "upper bound of", math.inf),
    "fhat": ("hat", "estimate of", 0.0),
    "f_lower": ("lower", "lower bound of", -math.inf),
    "f_upper": ("upper", "upper bound of", math.inf),
    "mean_lower": ("mean_lower", "lower bound of the mean over the window of", -math.inf),
    "mean_upper": ("mean_upper", "upper bound of the mean over the window of", math.inf),
    "alarm": ("alarm", "whether the interval excludes zero of", 0.0),
}
_BITS = "sum of " + ", ".join(f"{bit} {word.replace('_', ' ')}" for word, bit in STATUS.items())


@dataclass(frozen=True, repr=False)
class Fmu(Tabled):
    """A unit for co-simulation on the disk.

    Attributes
    ----------
    name : str
        Its model identifier.
    path : Path
    guid : str
    inputs, outputs, parameters : tuple of str
        Names of the variables.
    platform : str or None
        For which a binary is inside; None where there is none, but sources only.
    build : Build or None
        How it was compiled; None where there is no compiler.
    comparison : Comparison or None
        That all vectors are equal to the last bit; None where there is no compiler.
    """

    name: str
    path: Path
    guid: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    parameters: tuple[str, ...]
    platform: str | None
    build: Build | None
    comparison: Comparison | None

    def table(self) -> Table:
        """Tabulate its variables, what is inside, and how it was compared."""
        names = {kind: getattr(self, kind) for kind in ("inputs", "outputs", "parameters")}
        rows = {kind: ", ".join(found) or "none" for kind, found in names.items()}
        rows["binary"] = self.platform or "none, sources only"
        rows["comparison"] = str(self.comparison or "not done: no C compiler")
        return Table(f"FMU {self.name}: {self.path}", ("", ""), [*rows.items()])


@takes(observer="Observer FaultDetector")
def generate_fmu(
    observer: Observer | FaultDetector,
    path: str | PathLike[str],
    name: str | None = None,
    *,
    guess: ArrayLike | None = None,
    x_range: ArrayLike | None = None,
    f_range: ArrayLike | None = None,
    backend: Literal["casadi", "tape"] = "tape",
    vectors: int = 1000,
    seed: int = 0,
    overwrite: bool = False,
) -> Fmu:
    """Write a unit for co-simulation (FMI 2.0) of an observer or a fault detector.

    Inputs are u, y and theta of the plant, by their names and units; outputs are the estimates
    (``h_hat``), bounds (``h_lower``, ``h_upper``), alarms (``f_alarm``), means over a window and
    the status. Sources are inside, and a binary where a compiler is found. A communication step
    takes the sample time, or a multiple of it. The same arguments give the same bytes on a
    machine.

    Parameters
    ----------
    observer : Observer or FaultDetector
        Of any method.
    path : path
        The file, ``.fmu``. It is replaced only when the new one is complete and compared.
    name : str, optional
        Model identifier, a C name; made from the plant's name by default.
    guess : array_like of shape (n,), optional
        Where the first state is thought to be, by default the nominal state.
    x_range, f_range : array_like of shapes (n, 2) and (n_f, 2), optional
        Boxes of the first state and the first faults, see `Observer.memory0`. Where the first
        memory depends on guess and ranges as a sum, these are parameters of the unit
        (``h_guess``, ``h_first_lower``, ``h_first_upper``), and what is given here their start.
    backend, vectors, seed
        As of `generate_c`.
    overwrite : bool
        Replace an older unit in the same place. Any other file is refused all the same.

    Returns
    -------
    Fmu

    Raises
    ------
    CodegenError
        If an option is not available, the observer cannot ship or the file is not free.
    BuildError
        If the compiler rejects the code.
    ComparisonError
        If the compiled step differs from CasADi's virtual machine in any bit.

    Examples
    --------
    >>> import obsynth as ob
    >>> plant = ob.plants.cruise_control().discretise("euler", Ts=0.1)
    >>> observer = ob.BoundedErrorUIO(bounds="peak").design(plant)
    >>> generate_fmu(observer, "tank.zip")
    Traceback (most recent call last):
    ...
    obsynth.codegen.errors.CodegenError: tank.zip: name a file that ends with .fmu

    References
    ----------
    Functional Mock-up Interface for Model Exchange and Co-Simulation, version 2.0.
    """
    target = _checked(Path(path), overwrite)
    start = start_of(observer, guess, x_range, f_range)
    description = describe(observer, name, start.memory)
    kernel, recorded = write_step(description, backend, vectors, seed)
    name = description.name
    values = {**template_values(description, kernel, recorded, start_given=True), "guid": ""}
    variables = _variables(description, start, values["example"][0])
    values |= _template_values(variables, start)
    project = render(description, kernel, recorded, start_given=True)
    templates = {
        _DESCRIPTION: f"{_DESCRIPTION}.j2",
        f"sources/fmi2_{name}.c": "fmi2.c.j2",
        "documentation/index.html": "fmu.html.j2",
    }
    files = {
        f"sources/{name}.h": project[f"include/{name}.h"],
        f"sources/{name}.c": project[f"src/{name}.c"],
        f"sources/{name}_kernel.h": project[f"src/{name}_kernel.h"],
        "resources/design.json": description.design,
        **fill(description, templates, values),
    }
    told = hashlib.sha256("\0".join(files.values()).encode()).digest()
    values["guid"] = f"{{{uuid.UUID(bytes=told[:16])}}}"
    files |= fill(description, templates, values)
    kind, ending = _PLATFORMS.get((sys.platform, platform.machine()), (None, ""))
    with TemporaryDirectory(prefix="obsynth-fmu-") as place, replaced(target) as beside:
        built = Path(place) / f"{name}.{ending}"
        interface = Path(place) / "src" / f"fmi2_{name}.c"
        project[f"src/{interface.name}"] = files[f"sources/{interface.name}"]
        options: dict[str, Any] = {"extra_flags": _FLAGS}
        if kind is not None:
            options["shared"] = (built, interface)
        build, comparison = compared(Path(place), project, name, recorded, **options)
        binary = kind if built.exists() else None
        contents = {path: text.encode() for path, text in files.items()}
        if binary is not None:
            contents[f"binaries/{binary}/{built.name}"] = built.read_bytes()
        _pack(beside, contents)
        _checked(target, overwrite)
    names = {kind: tuple(v.name for v in variables if v.causality == kind) for kind in _ORDER}
    return Fmu(
        name=name,
        path=target,
        guid=values["guid"],
        inputs=names["input"],
        outputs=names["output"],
        parameters=names["parameter"],
        platform=binary,
        build=build,
        comparison=comparison,
    )


def _checked(path: Path, overwrite: bool) -> Path:
    """Return the file's full path, or refuse one that is not free."""
    target = path.expanduser().resolve()
    if path.suffix != ".fmu":
        raise CodegenError(f"{path}: name a file that ends with .fmu", path=str(path))
    if not target.parent.is_dir():
        raise CodegenError(f"{target}: there is no folder {target.parent}", path=str(target))
    if target.exists():
        ours = target.is_file() and zipfile.is_zipfile(target)
        if not ours or _DESCRIPTION not in zipfile.ZipFile(target).namelist():
            raise CodegenError(f"{target} is no FMU; name another file", path=str(target))
        if not overwrite:
            raise CodegenError(
                f"{target} is there already; say overwrite=True to replace it", path=str(target)
            )
    return target


def _pack(path: Path, contents: dict[str, bytes]) -> None:
    """Write an archive whose bytes are those of its files, whenever it is written."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as unit:
        for name, data in sorted(contents.items()):
            entry = zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))
            entry.compress_type, entry.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
            unit.writestr(entry, data)


def _variables(description: Description, start: Start, inputs: Sequence[str]) -> list[Variable]:
    """Return the variables in the order of their references: parameters, inputs, then outputs.

    Real outputs come before booleans, these before integers; inputs: lists of C of start values.
    """
    found = list(start.parameters)
    for kind, values in zip(_INPUTS, inputs, strict=True):
        ports: tuple[Port, ...] = getattr(description, kind)
        numbers = (float(text.rstrip("f")) for text in values.split(", ") if text)
        for port, value in zip(ports, numbers, strict=True):
            told = f"{_INPUTS[kind]} {port}"
            found.append(Variable(port.name, "Real", "input", kind, value, told, port.unit))
    further = {name for name, _ in description.further}
    for kind, (ending, told, first) in _OUTPUTS.items():
        if kind in STEP_OUTPUTS or kind in further:
            for port in description.f if kind[0] in "fam" else description.x:
                name, unit = f"{port.name}_{ending}", "" if kind == ALARM_OUTPUT else port.unit
                type_: Any = "Boolean" if kind == ALARM_OUTPUT else "Real"
                told_ = f"{told} {port.name}"
                found.append(Variable(name, type_, "output", kind, first, told_, unit))
    words = ("status", *further & {"mean_status"})
    found += [Variable(kind, "Integer", "output", kind, 1.0, _BITS) for kind in words]
    names: dict[str, int] = {}
    for i in sorted(range(len(found)), key=lambda i: found[i].causality != "input"):
        name, count = found[i].name, 1
        while name in names:
            count += 1
            name = f"{found[i].name}_{count}"
        names[name] = i
        found[i] = replace(found[i], name=name)
    return found


def _template_values(variables: Sequence[Variable], start: Start) -> dict[str, Any]:
    """Return what the templates of a unit call by name beside those of a project."""
    ranks = [_RANKS.index(v.type if v.causality == "output" else v.causality) for v in variables]
    fields = [v.field for v in variables]
    return {
        "ordered": variables,
        "variables": sorted(enumerate(variables), key=lambda item: _ORDER.index(item[1].causality)),
        "units": sorted({v.unit for v in variables if v.unit}),
        "ends": [sum(rank <= i for rank in ranks) for i in range(len(_RANKS))],
        "guesses": start.guesses,
        "places": [(k, fields.index(k), fields.count(k)) for k in dict.fromkeys(fields) if k],
        "rules": start.rules,
        "largest": start.largest,
    }
