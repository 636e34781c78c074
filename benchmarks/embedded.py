"""What does a step cost on small processors, beside C that is written by hand?

The core of the four-tank step with peak bounds, without contractor and guard, and the whole step.
`by_hand/core.c` was written and frozen before the tape's writer was looked at. Instructions are
those of `make firmware`, which installs what is needed; x86 times are the least of many passes.

Usage: python benchmarks/embedded.py
"""

import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import sympy as sp

import obsynth as ob
from obsynth.codegen.casadi_text import generate_kernel
from obsynth.codegen.kernel import DOUBLE, REALS, RESULTS, Kernel, Real
from obsynth.codegen.single import machine_of
from obsynth.codegen.tape import write_tape
from obsynth.derive.rigour import inward
from obsynth.designs.core.boxes import Rounding
from obsynth.designs.core.core import Seen
from obsynth.designs.core.half_widths import ROUND_UP, ULPS
from obsynth.designs.core.observer import STEP_OUTPUTS
from obsynth.designs.general.step import build_core, memory_sizes, running
from obsynth.symbolic import Table

HERE = Path(__file__).parent
HAND = HERE / "by_hand"
FIRMWARE = HERE.parent / "tools" / "firmware"
sys.path.insert(0, str(FIRMWARE))

from boards import CORES, FLAGS, RECORDS, TIMED, apart, compiler, emulator, recorded, run  # noqa: E402

WRITERS = {
    "by_hand": "by hand",
    "tape": "tape",
    "casadi": "CasADi's text",
    "raw": "CasADi as it is",
}
ASKED = (
    ("double", "M4F", 1.1),
    ("double", "M7", 1.2),
    ("single", "M4F", 1.0),
    ("single", "M7", 1.2),
)
"""What the tape may take of the instructions of the step by hand."""
UNUSED = ("unused-parameter", "unused-function")
OUTPUTS = ("xhat", "fhat", "x_lower", "f_lower", "x_upper", "f_upper")
"""Results of the core in the order of by_hand/core.h."""


def four_tanks(precision: Any) -> ob.Observer:
    """Design the observer with peak bounds."""
    plant = ob.plants.quadruple_tank().discretise("euler", Ts=1.0)
    return ob.BoundedErrorUIO(bounds="peak", precision=precision).design(plant)


def core_of(observer: ob.Observer) -> ca.Function:
    """Return the core's own step, all readings used, with inputs and outputs of a step."""
    design: Any = observer.certificate.design
    sizes = memory_sizes(design)
    memory = ca.SX.sym("memory", sum(sizes.values()))
    u, y = (ca.SX.sym(name, observer.step.numel_in(name)) for name in "uy")
    parts = ca.vertsplit(memory, np.cumsum([0, *sizes.values()]).tolist())
    given = dict(zip(sizes, parts, strict=True))
    known = build_core(design).run(Seen(given, u, ca.SX(0, 1), y, [ca.SX(1)] * y.numel()))
    assert known.x is not None
    assert known.f is not None
    outputs = [ca.vertcat(*(known.moved[name] for name in sizes)), known.xhat, known.fhat]
    outputs += [known.x.lower, known.x.upper, known.f.lower, known.f.upper, known.sound]
    ends = np.cumsum([0, *(value.numel() for value in outputs)]).tolist()
    together = ca.vertsplit(ca.cse(ca.densify(ca.vertcat(*outputs))), ends)
    return ca.Function("core", [memory, u, y], together, ["memory", "u", "y"], [*RESULTS[:8]])


def numbers(observer: ob.Observer) -> str:
    """Return the numbers of `by_hand/core.c` as a header."""
    design: Any = observer.certificate.design
    real, precision = REALS[observer.precision], observer.precision

    def text(value: Any) -> str:
        if isinstance(value, (Sequence, np.ndarray)):
            return "{" + ", ".join(text(entry) for entry in value) + "}"
        return np.format_float_scientific(real.type(value), unique=True, trim="0") + real.suffix

    def array(name: str, value: Any) -> str:
        size = "".join(f"[{n}]" for n in np.shape(value))
        return f"static const real {name}{size} = {text(value)};"

    # what the third reading corrects is nothing, and K is zero
    assert not design.Z[:, 2].any()
    assert not design.K.any()
    limits, (bound,) = design.limits, running(design)
    value = {sp.Symbol(s.name): s.value for s in design.plant.constants}
    a, A = sp.symbols("a1:5"), sp.symbols("A1:5")
    outflow = [sp.sqrt(2 * sp.Symbol("g")) * a[i] / A[i] for i in range(4)]
    k1, k2, g1, g2 = sp.symbols("k1 k2 gamma1 gamma2")
    pumps = {
        "PUMP1_H1": g1 * k1 / A[0],
        "PUMP2_H2": g2 * k2 / A[1],
        "PUMP1_H4": (1 - g1) * k1 / A[3],
    }
    middle = design.middle
    scalars = {
        **{name: float(sp.N(row.subs(value), 40)) for name, row in pumps.items()},
        "SLOPE_13": middle[0, 2],
        "SLOPE_24": middle[1, 3],
        "ROUND_UP": ROUND_UP,
        "ULPS": ULPS * Rounding(precision).step / Rounding().step,
        "ZERO": 0.0,
    }
    arrays = {
        "LIMITS": inward(limits.x, precision),
        "U_LIMITS": inward(limits.u, precision),
        "BOX": inward(design.plant.box("x"), precision),
        "Z": design.Z[:, :2],
        "REACH": bound.reach * bound.more,
        "ADD": bound.add * bound.more,
        "DECAY": bound.decay * bound.more,
        "OUTFLOW": [float(sp.N(row.subs(value), 40)) for row in outflow],
        "SLOPE": middle.diagonal()[:4],
    }
    mathematics = [f"#define {name.upper()} {name}{real.suffix}" for name in ("fabs", "sqrt")]
    lines = ["#include <math.h>", *mathematics]
    lines += [f"#define {name} {text(number)}" for name, number in scalars.items()]
    return "\n".join(lines + [array(name, values) for name, values in arrays.items()]) + "\n"


def records_of(observer: ob.Observer, core: ca.Function) -> np.ndarray:
    """Return memories with inputs and readings, (N, n); behind the timed ones a tenth far out."""
    rng, rows = np.random.default_rng(1), []
    x, u = observer.model.box("x"), observer.model.box("u")
    for k in range(RECORDS):
        far = 3.0 if k >= TIMED and k % 10 == 0 else 1.0
        p = x.mean(axis=1) + far * rng.uniform(-0.5, 0.5, 4) * np.ptp(x, axis=1)
        s = rng.uniform(0, 10, core.numel_in(0) - 6) ** 2
        inputs = u[:, 0] + far * rng.uniform(0, 1, 2) * np.ptp(u, axis=1)
        rows.append([*p, *rng.uniform(-3, 3, 2), *s, *inputs, *(p[:3] + rng.uniform(-1, 1, 3))])
    return np.array(rows)


def results_of(core: ca.Function, records: np.ndarray, machine: Any) -> np.ndarray:
    """Return outputs, status and next memory of every record, as the programs do."""
    rows = []
    for row in records:
        found = machine(*np.split(row, np.cumsum([core.numel_in(0), core.numel_in(1)])))
        told = dict(zip(STEP_OUTPUTS, found, strict=True))
        rows.append(np.concatenate([told[n] for n in (*OUTPUTS, "status", "memory_next")]))
    return np.array(rows)


def header(core: ca.Function, name: str, real: Real) -> str:
    """Return a header with the structs of a step and its prototype."""
    size = {**dict(zip(STEP_OUTPUTS, map(core.numel_out, range(core.n_out())), strict=True))}
    size |= {name: core.numel_in(i) for i, name in enumerate(("memory", "u", "y"))}
    lines = [f"typedef {real.c} {name}_real_t;"]
    for kind, parts in (("state", ["memory"]), ("in", ["u", "y"]), ("out", OUTPUTS)):
        fields = " ".join(f"{real.c} {part}[{size[part]}];" for part in parts)
        lines.append(f"typedef struct {{ {fields} }} {name}_{kind}_t;")
    lines.append(f"int {name}_step({name}_state_t *, const {name}_in_t *, {name}_out_t *);")
    return "\n".join(lines) + "\n"


def _place(port: str, i: int) -> str:
    owner = "state" if port in {"memory", "next"} else "in" if port in {"u", "y"} else "out"
    return f"{owner}->{port.replace('next', 'memory')}[{i}]"


def step_text(core: ca.Function, name: str, real: Real) -> str:
    """Return the source of a step: of the tape, of CasADi's text in plain arrays, or as it is."""
    head = f"int {name}_step({name}_state_t *state, const {name}_in_t *in, {name}_out_t *out)"
    size = core.numel_in(0)
    buffers = (
        f"{real.c} memory[{size}], next[{size}], status[1];\n    {name}_out_t result;\n"
        f"    int i;\n    for (i = 0; i < {size}; ++i) {{ memory[i] = state->memory[i]; }}\n"
    )
    after = (
        f"    for (i = 0; i < {size}; ++i) {{ state->memory[i] = next[i]; }}\n"
        "    *out = result;\n    return (int)status[0];"
    )
    kernel: Kernel
    if name == "tape":
        kernel = write_tape(core, name, _place, real)
        text, body = kernel.functions, f"return (int){name}_kernel(state, in, out);"
    elif name == "casadi":
        kernel = generate_kernel(core, name)
        own = {"memory": "memory", "next": "next", "status": "status", "u": "in->u", "y": "in->y"}
        called = ", ".join(own.get(word, f"result.{word}") for word in kernel.arguments)
        text, body = kernel.functions, f"{buffers}    {name}_kernel({called});\n{after}"
    else:
        generator = ca.CodeGenerator("raw", {"with_header": False})
        generator.add(core, False)
        quiet = "".join(f'#pragma GCC diagnostic ignored "-W{w}"\n' for w in UNUSED)
        text = f"{quiet}#define casadi_real {real.c}\n{generator.dump()}"
        results = ", ".join(f"result.{word}" for word in STEP_OUTPUTS[1:-1])
        body = (
            f"{buffers}    {{\n        const {real.c} *arg[3] = {{memory, in->u, in->y}};\n"
            f"        {real.c} *res[8] = {{next, {results}, status}};\n"
            f"        (void)core(arg, res, NULL, NULL, 0);\n    }}\n{after}"
        )
    headers = f'#include "{name}.h"\n#include <math.h>\n#include <stddef.h>\n'
    return f"{headers}{text}\n\n{head}\n{{\n    {body}\n}}\n"


def by_hand(observer: ob.Observer, folder: Path, real: Real) -> None:
    """Write the step by hand with its numbers, under the names of the others."""
    single = "#define SINGLE\n" if real.precision == "single" else ""
    types = "typedef real by_hand_real_t;\ntypedef by_hand_memory_t by_hand_state_t;\n"
    (folder / "numbers.h").write_text(numbers(observer))
    (folder / "by_hand.h").write_text(f'{single}#include "core.h"\n{types}')
    (folder / "by_hand.c").write_text(f'{single}#include "core.c"\n')


def nanoseconds(name: str, source: Path, include: Sequence[Path], records: np.ndarray) -> float:
    """Return the time of a step here, compiled apart."""
    with tempfile.TemporaryDirectory() as place:
        (Path(place) / "records.bin").write_bytes(records.tobytes())
        told = [f'-DPROJECT="{name}.h"', f"-DNAME={name}", *(f"-I{path}" for path in include)]
        files = [str(source), str(HAND / "time.c"), "-o", "time", "-lm"]
        subprocess.run(["gcc", "-std=c99", *FLAGS, *told, *files], cwd=place, check=True)
        runs = [subprocess.check_output(["./time"], cwd=place, text=True) for _ in range(5)]
    return min(float(text) for text in runs)


Told = tuple[float, float, float, float, int]


def row(
    name: str, source: Path, include: Sequence[Path], records: np.ndarray, made: np.ndarray
) -> Told:
    """Return ns here, instructions on M3, M4F and M7, and how many records differ."""
    ran = [run(core, name, [source], include, records, made.shape[1], "c99") for core in CORES]
    differ = max(int(apart(made, one.found).any(axis=1).sum()) for one in ran)
    here = nanoseconds(name, source, include, records[:TIMED])
    return here, *(one.instructions for one in ran), differ


def cores(observer: ob.Observer, real: Real) -> Iterator[tuple[str, str, Told]]:
    """Measure the core, written in every way."""
    core = core_of(observer)
    records = records_of(observer, core).astype(real.type)
    made = results_of(core, records, machine_of(core, real)).astype(real.type)
    for name in WRITERS:
        if name == "casadi" and real is not DOUBLE:
            continue
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place)
            if name == "by_hand":
                by_hand(observer, folder, real)
            else:
                (folder / f"{name}.h").write_text(header(core, name, real))
                (folder / f"{name}.c").write_text(step_text(core, name, real))
            told = row(name, folder / f"{name}.c", [folder, HAND], records, made)
        yield real.precision, WRITERS[name], told


def whole(observer: ob.Observer, real: Real) -> Iterator[tuple[str, str, Told]]:
    """Measure the whole step, contractor and guard included."""
    records, made = recorded(observer)
    for backend in ("tape", "casadi") if real is DOUBLE else ("tape",):
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place) / "project"
            name = ob.generate_c(observer, folder, backend=backend, vectors=100).name
            source, include = folder / "src" / f"{name}.c", [folder / "include"]
            told = row(name, source, include, records, made)
        yield real.precision, f"whole step, {WRITERS[backend]}", told


def main() -> int:
    """Print the table; return 1 where a result differs or a ratio is missed."""
    subprocess.run(["sh", str(FIRMWARE.parent / "install.sh"), "firmware"], check=True)
    print(f"{compiler()}; {emulator()}; -std=c99 -O2")
    rows = []
    for real in REALS.values():
        observer = four_tanks(real.precision)
        for precision, name, told in (*cores(observer, real), *whole(observer, real)):
            rows.append([precision, name, f"{told[0]:.1f}", *map(round, told[1:])])
    heads = ["", "four tanks, peak", "x86 ns", *(f"{core} instr." for core in CORES), "differ"]
    print(Table(f"One step; which of {RECORDS} records differ from CasADi's machine", heads, rows))
    missed = sum(line[-1] > 0 for line in rows)
    for precision, core, asked in ASKED:
        hand, tape = (
            line[3 + [*CORES].index(core)]
            for line in rows
            if line[:2] in ([precision, WRITERS["by_hand"]], [precision, WRITERS["tape"]])
        )
        met = tape <= asked * hand
        missed += not met
        told = f"{precision}, {core}: tape {tape / hand:.3f} of by hand, asked {asked}"
        print(told, "met" if met else "MISSED")
    return int(missed > 0)


if __name__ == "__main__":
    sys.exit(main())
