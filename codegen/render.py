"""The text files of a project, from templates."""

import keyword
import math
import sys
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from obsynth.codegen.description import Description, Port, midpoints
from obsynth.codegen.kernel import DOUBLE, Kernel, Machine, Real
from obsynth.codegen.names import c_comment
from obsynth.codegen.recording import Vectors
from obsynth.derive.equilibrium import operating_values
from obsynth.designs.core.observer import STATUS
from obsynth.symbolic.arrays import FloatArray

_MEANINGS = {
    "not_initialised": "the state has not been initialised; nothing else is of use",
    "non_finite_input": "an input is NaN, infinite or absurdly large: the sets begin anew",
    "outside_domain": "the returned set, or a scheduling signal, is outside of the domain where "
    "the guarantee holds",
    "void": "a set is empty or a reading impossible: an assumption failed since the last void "
    "step; the declared ranges are returned",
    "fault_not_valid": "the fault estimate and its bounds are not valid",
    "measurement_left_out": "a reading is missing or outside of its range, and left out",
    "recovering": "fewer steps than the recovery since a void one",
}

_ARGUMENTS = {
    "memory": "memory",
    "u": "in->u",
    "y": "in->y",
    "theta": "in->theta",
    "next": "next",
    "status": "status",
}

_EXAMPLE_STEPS = 5


def generator_name() -> str:
    """Return name and version of this package, as generated files show them."""
    return f"obsynth {version('obsynth')}"


def _example(description: Description) -> list[tuple[str, ...]]:
    """Return u, y and theta of a plant that starts in its nominal state."""
    model = description.observer.model
    plant = Machine(model.function())
    x, u = operating_values(model, "x"), operating_values(model, "u")
    d, w, p, rho = (midpoints(model, kind) for kind in ("d", "w", "p", "rho"))
    if description.scheduling:
        rho = operating_values(model, "rho")
    theta = rho[list(description.scheduling)]
    rows = []
    for _ in range(_EXAMPLE_STEPS):
        following, y = plant(x, u, d, np.zeros(len(model.f)), w, p, rho)
        rows.append(tuple(_row(values, description.real) for values in (u, y, theta)))
        x = following
    return rows


def _row(values: FloatArray, real: Real) -> str:
    # Six digits serve an example; a plant that diverges must not break its C.
    known = np.abs(values) <= np.finfo(real.type).max
    return ", ".join(real.number(float(f"{v:.6g}")) for v in np.where(known, values, 0.0))


def _listed(ports: tuple[Port, ...]) -> str:
    return ", ".join(f"{p.name} [{p.unit}]" if p.unit else p.name for p in ports)


def render(
    description: Description, kernel: Kernel, vectors: Vectors, start_given: bool
) -> dict[str, str]:
    """Return the files of a project, without its manifest."""
    name = description.name
    templates = {
        f"include/{name}.h": "header.h.j2",
        f"src/{name}.c": "source.c.j2",
        f"src/{name}_kernel.h": "kernel.h.j2",
        f"tests/test_{name}.c": "runner.c.j2",
        "tests/vectors_small.c": "small.c.j2",
        "examples/main.c": "example.c.j2",
        f"src/{name}.h": "forward.h.j2",
        "CMakeLists.txt": "CMakeLists.txt.j2",
        "library.json": "library.json.j2",
        "library.properties": "library.properties.j2",
        "zephyr/module.yml": "module.yml.j2",
        "Makefile": "Makefile.j2",
        "pyproject.toml": "pyproject.toml.j2",
        "python/library.c": "library.c.j2",
        f"python/{package_name(name)}/__init__.py": "package.py.j2",
        "README.md": "README.md.j2",
    }
    values = template_values(description, kernel, vectors, start_given)
    files = fill(description, templates, values)
    files["tests/vectors.txt"] = vectors.text
    files["design.json"] = description.design
    return files


def package_name(name: str) -> str:
    """Return the name of the Python package of a project: none of the language or its library."""
    taken = keyword.iskeyword(name) or name in sys.stdlib_module_names
    return f"{name}_observer" if taken else name


def fill(
    description: Description, templates: Mapping[str, str], values: Mapping[str, Any]
) -> dict[str, str]:
    """Fill in templates: texts by the paths of their files."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent / "templates"),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        autoescape=False,
    )
    real, prefix = description.real, description.name
    environment.filters["number"] = real.number
    environment.filters["constant"] = lambda value: real.literal(value, f"{prefix}_real_t")
    environment.filters["double"] = lambda value: DOUBLE.literal(value, "double")
    environment.filters["comment"] = c_comment
    environment.filters["cell"] = lambda text: " ".join(text.replace("|", "\\|").split())
    return {path: environment.get_template(name).render(values) for path, name in templates.items()}


def template_values(
    description: Description, kernel: Kernel, vectors: Vectors, start_given: bool
) -> Mapping[str, Any]:
    """Return what the templates of a project call by name."""
    observer, sizes = description.observer, description.sizes
    signals = {"u": description.u, "y": description.y, "theta": description.theta}
    signals |= {"x": description.x, "f": description.f}
    start = operating_values(observer.model, "x")
    return {
        "name": description.name,
        "macro": description.name.upper(),
        "package": package_name(description.name),
        "names": {kind: tuple(p.name for p in ports) for kind, ports in signals.items()},
        "units": {kind: tuple(p.unit for p in ports) for kind, ports in signals.items()},
        "generator": generator_name(),
        "casadi": ca.CasadiMeta.version(),
        "method": observer.method,
        "plant": observer.model.name,
        "hashes": {
            "model": description.model_hash,
            "design": description.design_hash,
            "certificate": description.certificate_hash,
        },
        "sample_time": description.sample_time,
        "fault_delay": observer.fault_delay,
        "n": sizes,
        "signals": [(kind, ports) for kind, ports in signals.items() if ports],
        "signals_text": {kind: _listed(ports) for kind, ports in signals.items()},
        "status": [
            {"name": bit, "value": value, "meaning": _MEANINGS.get(bit, bit.replace("_", " "))}
            for bit, value in STATUS.items()
        ],
        "all_bits": sum(STATUS.values()),
        "fields": description.fields,
        "start": description.start,
        "start_given": start_given,
        "start_guess": [] if start_given else list(zip(description.x, start, strict=True)),
        "kernel": kernel,
        "real": description.real,
        "machine": f"instructions in NumPy's float{description.real.bits}"
        if description.real.bits == 32
        else "CasADi's virtual machine",
        "call": ",\n        ".join(
            _ARGUMENTS.get(name, f"result.{name}") for name in kernel.arguments
        ),
        "reads_in": bool({"u", "y", "theta"} & set(kernel.arguments)),
        "inputs": [kind for kind in ("u", "y", "theta") if signals[kind]],
        "library": kernel.library,
        "inexact": kernel.inexact,
        "alarms": bool(description.further),
        "window": getattr(observer, "window", None),
        "outputs": [(name, length) for name, length in description.outputs if length],
        "example": _example(description),
        "count": vectors.count,
        "numbers": sum(sizes.get(kind, 0) for kind in ("u", "y", "theta"))
        + sum(length for _, length in description.outputs),
        "small": vectors.small,
        "few": vectors.few,
        "word": vectors.word,
        "kinds": vectors.kinds,
        "claims": [" ".join(text.split()) for text in observer.guarantee.claims],
        "assumptions": [" ".join(text.split()) for text in observer.guarantee.assumptions],
        "inf": math.inf,
    }
