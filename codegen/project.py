"""`generate_c`: a C project of one observer step, built and compared on the spot."""

import hashlib
import json
import operator
import os
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

from obsynth.codegen.box import input_box
from obsynth.codegen.build import FLAGS, Build, Comparison, build_and_compare, find_compiler
from obsynth.codegen.casadi_text import generate_kernel
from obsynth.codegen.description import Description, Port, describe
from obsynth.codegen.errors import BuildError, CodegenError
from obsynth.codegen.folder import MANIFEST, complete_folder
from obsynth.codegen.kernel import DOUBLE, REALS, Kernel, counted, instructions, scalar_function
from obsynth.codegen.numbers import prove_numbers
from obsynth.codegen.recording import Vectors
from obsynth.codegen.render import package_name, render
from obsynth.codegen.tape import read_tape, write_tape
from obsynth.codegen.vectors import COUNT, make_vectors
from obsynth.designs.core.observer import STATUS, Observer
from obsynth.designs.detection.detector import FaultDetector
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.table import Table, Tabled
from obsynth.symbolic.taking import takes

PRECISIONS = tuple(REALS)
"""Precisions that a project can be generated for."""

BACKENDS = ("casadi", "tape")
"""Writers of the kernel: CasADi, or ours from CasADi's instructions."""

KIND = "obsynth C project"

_FORMAT = 1
_TOOLS = ("obsynth", "casadi", "numpy", "sympy", "jinja2")
_BUILT = ("build/", "dist/")
_ARITHMETIC = (
    "every operation of {} is rounded once, to the nearest number, and kept in its type",
    "numbers below the normal ones are kept, not taken for zero",
    "no operations are fused, exchanged or left out",
)


@dataclass(frozen=True, repr=False)
class CProject(Tabled):
    """A C project on the disk.

    Attributes
    ----------
    name : str
        Prefix of every C name.
    folder : Path
    files : tuple of str
        Paths relative to the folder, sorted.
    sizes : mapping of str to int
        Lengths of memory, u, y, theta (scheduled observers), x, f.
    operations : int
        Instructions of the step.
    vectors : int
        Number of recorded steps.
    statuses : mapping of int to int
        How often the recorded steps returned which status.
    build : Build or None
        How it was compiled; None where there is no compiler.
    comparison : Comparison or None
        That all vectors are equal to the last bit; None where there is no compiler.
    """

    name: str
    folder: Path
    files: tuple[str, ...]
    sizes: Mapping[str, int]
    operations: int
    vectors: int
    statuses: Mapping[int, int]
    build: Build | None
    comparison: Comparison | None

    def table(self) -> Table:
        """Tabulate where it is, how large, and how it was built and compared."""
        sizes = ", ".join(f"{count} {kind}" for kind, count in self.sizes.items())
        rows = [
            ("folder", str(self.folder)),
            ("step", f"{self.operations} operations; {sizes}"),
        ]
        if self.build is None or self.comparison is None:
            missing = "not compiled: no C compiler found (CC, cc, gcc, clang)"
            rows.append(("build", missing))
            rows.append(
                ("comparison", f"not done; `make test` compares the {self.vectors} recorded steps")
            )
        else:
            rows.append(("build", str(self.build)))
            rows.append(("comparison", str(self.comparison)))
        return Table(f"C project {self.name}", ("", ""), rows)


@takes(observer="Observer FaultDetector")
def generate_c(
    observer: Observer | FaultDetector,
    folder: str | os.PathLike[str],
    name: str | None = None,
    precision: Literal["double", "single"] | None = None,
    backend: Literal["casadi", "tape"] | None = None,
    vectors: int = COUNT,
    seed: int = 0,
    overwrite: bool = False,
    memory: FloatArray | None = None,
) -> CProject:
    """Write a C project of one observer step; build it and compare it where a compiler is there.

    The project holds a header without CasADi's types (state, inputs and outputs as structs with
    the signals' names and units; init, step, status bits), the sources (no heap, no global data),
    recorded steps of CasADi's virtual machine with a program that compares them, an example,
    CMake and make files, a README and a manifest. The same observer and options give the same
    bytes.

    Parameters
    ----------
    observer : Observer or FaultDetector
    folder : path
        Where the project shall be. It appears there only when it is complete and compared.
    name : str, optional
        Prefix of every C name; made from the plant's name by default.
    precision : {"double", "single"}, optional
        Type of all numbers, ``double`` or ``float``; that of the design by default. An observer
        has to be designed for single precision, whose rounding its bounds then count.
    backend : {"casadi", "tape"}, optional
        Who writes the kernel: CasADi's code generation (default in double precision), or our own
        from the instructions of the same function, shorter and quicker (the only one in single
        precision). Interface and results are the same to the last bit.
    vectors : int
        Number of recorded steps, at least 100: most of them healthy ones, and steps on both sides
        of every limit that the step compares something with.
    seed : int
        Seed of the vectors.
    overwrite : bool
        Replace an older project in the same place. A folder that holds anything else is
        refused all the same.
    memory : ndarray of shape (n_memory,), optional
        What ``NAME_init_default`` sets, from ``observer.memory0``; by default the memory for the
        nominal state (the middle of its range) and the declared ranges.

    Returns
    -------
    CProject

    Raises
    ------
    CodegenError
        If an option is not available, the observer cannot ship or the folder is not free.
    BuildError
        If the compiler rejects the code.
    ComparisonError
        If the compiled step differs in any bit from CasADi's virtual machine, or, in single
        precision, from its instructions in NumPy's float32.

    Examples
    --------
    >>> import obsynth as ob
    >>> plant = ob.plants.cruise_control().discretise("euler", Ts=0.1)
    >>> observer = ob.BoundedErrorUIO(bounds="peak").design(plant)
    >>> generate_c(observer, folder="tank", precision="float")
    Traceback (most recent call last):
    ...
    obsynth.codegen.errors.CodegenError: precision='float' is not available; available: 'double', \
'single'
    """
    _available("precision", precision, (*PRECISIONS, None))
    description = describe(observer, name, memory, precision)
    kernel, recorded = write_step(description, backend, vectors, seed)
    files = render(description, kernel, recorded, start_given=memory is not None)
    files[MANIFEST] = _manifest(description, kernel, recorded, operator.index(seed), files)

    built = (*_BUILT, f"python/{package_name(description.name)}.egg-info/")
    with complete_folder(folder, KIND, overwrite=overwrite, built=built) as place:
        build, comparison = compared(place, files, description.name, recorded)
    return CProject(
        name=description.name,
        folder=Path(folder).expanduser().resolve(),
        files=tuple(sorted(files)),
        sizes=description.sizes,
        operations=kernel.operations,
        vectors=recorded.count,
        statuses=recorded.statuses,
        build=build,
        comparison=comparison,
    )


def write_step(
    description: Description, backend: str | None, vectors: int, seed: int
) -> tuple[Kernel, Vectors]:
    """Write the kernel and record its vectors."""
    _available("backend", backend, (*BACKENDS, None))
    count, start = _whole("vectors", vectors), _whole("seed", seed)
    if start < 0:
        raise CodegenError(f"seed={seed}; a seed is not negative", seed=seed)
    step, name, real = description.observer.step, description.name, description.real
    if backend == "casadi" and real is not DOUBLE:
        raise CodegenError(
            f"backend='casadi' computes with constants of double, not in {real.precision} precision"
            " (which the design has): say backend='tape', or precision='double'",
            backend=backend,
        )
    if backend == "tape" or real is not DOUBLE:
        kernel = write_tape(step, name, description.place, real)
    else:
        kernel = generate_kernel(step, name)
    return kernel, make_vectors(description, count, start)


def compared(
    place: Path, files: Mapping[str, str], name: str, recorded: Vectors, **build_options: Any
) -> tuple[Build, Comparison] | tuple[None, None]:
    """Write the files, build them and compare every recorded step; None without a compiler."""
    for path, text in files.items():
        file = place / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text, encoding="utf-8", newline="\n")
    compiler = find_compiler()
    if compiler is None:
        return None, None
    build, comparison = build_and_compare(place, name, compiler=compiler, **build_options)
    if (comparison.vectors, comparison.values) != (recorded.count, recorded.values):
        raise BuildError(
            f"the test compared {comparison.vectors} steps and {comparison.values} values of"
            f" {recorded.count} and {recorded.values}",
            command=compiler,
            output=str(comparison),
        )
    return build, comparison


def _available(option: str, value: str | None, values: tuple[str | None, ...]) -> None:
    if value not in values:
        known = tuple(name for name in values if name is not None)
        raise CodegenError(
            f"{option}={value!r} is not available; available: {', '.join(map(repr, known))}",
            option=option,
            available=known,
        )


def _whole(option: str, value: Any) -> int:
    try:
        return operator.index(value)
    except TypeError:
        raise CodegenError(f"{option}={value!r} is no whole number", option=option) from None


def _manifest(
    description: Description,
    kernel: Kernel,
    vectors: Vectors,
    seed: int,
    files: Mapping[str, str],
) -> str:
    observer, real = description.observer, description.real
    kinds = ("u", "y", "theta", "x", "f") if description.theta else ("u", "y", "x", "f")
    values, results = read_tape(observer.step, real)
    numbers = prove_numbers(values, results)
    data = {
        "kind": KIND,
        "format": _FORMAT,
        "name": description.name,
        "versions": {name: version(name) for name in _TOOLS},
        "flags": list(FLAGS),
        "model": {"name": observer.model.name, "sha256": description.model_hash},
        "design": {"sha256": description.design_hash, "detector": dict(description.detector)},
        "certificate": {"sha256": description.certificate_hash, "claims": list(description.claims)},
        "method": observer.method,
        "precision": real.precision,
        "backend": kernel.backend,
        "arithmetic": {
            "type": real.c,
            "format": f"binary{real.bits} of IEEE 754",
            "assumptions": [text.format(real.c) for text in _ARITHMETIC],
        },
        "sample_time": description.sample_time,
        "fault_delay": observer.fault_delay,
        "sizes": description.sizes,
        "bytes": {
            "state": real.bits // 8 * description.sizes["memory"],
            "out": real.bits // 8 * sum(length for _, length in description.outputs),
        },
        "memory": {
            field.name: [field.start, field.start + field.size] for field in description.fields
        },
        "signals": {kind: _signals(getattr(description, kind)) for kind in kinds},
        "input_box": input_box(description),
        "numbers_in_order": {
            "over": "all bit patterns of memory and inputs",
            "at_every_status": list(numbers.always),
            "at_status_0": list(numbers.quiet),
            "not_proved": list(numbers.unproved),
        },
        "guarantee": {
            "claims": list(observer.guarantee.claims),
            "assumptions": list(observer.guarantee.assumptions),
        },
        "operations": kernel.operations,
        "operations_of_backends": {
            "casadi": sum(instructions(scalar_function(observer.step)).values()),
            "tape": sum(counted(value.name for value in values).values()),
        },
        "operation_counts": dict(kernel.counts),
        "library_functions": list(kernel.library),
        "not_defined_to_the_last_bit": list(kernel.inexact),
        "own_functions_within_ulps": dict(kernel.own),
        "vectors": {
            "count": vectors.count,
            "seed": seed,
            "kinds": dict(vectors.kinds),
            "statuses": {str(status): times for status, times in vectors.statuses.items()},
            "bits_never_set": [
                name for name, bit in STATUS.items() if not any(bit & s for s in vectors.statuses)
            ],
        },
        "files": {
            path: hashlib.sha256(text.encode()).hexdigest() for path, text in sorted(files.items())
        },
    }
    return json.dumps(data, indent=2, allow_nan=False, ensure_ascii=False) + "\n"


def _signals(ports: tuple[Port, ...]) -> list[dict[str, str]]:
    return [{"name": port.name, "unit": port.unit} for port in ports]
