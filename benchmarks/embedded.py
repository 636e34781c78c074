"""What does a step cost on small processors, beside C that is written by hand?

The core of the four-tank step with peak bounds, without contractor and guard: `by_hand/core.c` was
written and frozen before the tape's writer was looked at.

Usage: python benchmarks/embedded.py
"""

import ctypes
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import sympy as sp

import obsynth as ob
from obsynth.designs.core.core import Seen
from obsynth.designs.core.running import ROUND_UP, ULPS
from obsynth.designs.general.step import Limits, build_core, memory_sizes, running

HAND = Path(__file__).parent / "by_hand"
STRICT = ["-std=c99", "-O2", "-ffp-contract=off", "-Wall", "-Wextra", "-Wconversion", "-Werror"]
SINGLE_UP = 2.0**-21
"""What stands for `ULPS` in single precision."""


def four_tanks() -> ob.Observer:
    """Design the observer with peak bounds."""
    plant = ob.plants.quadruple_tank().discretise("euler", Ts=1.0)
    return ob.BoundedErrorUIO(bounds="peak").design(plant)


def core_of(observer: ob.Observer) -> ca.Function:
    """Return the core's own step, all readings used: (memory, u, y) to sets and next memory."""
    design: Any = observer.certificate.design
    sizes = memory_sizes(design)
    memory = ca.SX.sym("memory", sum(sizes.values()))
    u, y = (ca.SX.sym(name, observer.step.numel_in(name)) for name in "uy")
    parts = ca.vertsplit(memory, np.cumsum([0, *sizes.values()]).tolist())
    given = dict(zip(sizes, parts, strict=True))
    known = build_core(design).run(Seen(given, u, ca.SX(0, 1), y, [ca.SX(1)] * y.numel()))
    assert known.x is not None
    assert known.f is not None
    outputs = {
        "moved": ca.vertcat(*(known.moved[name] for name in sizes)),
        "hat": ca.vertcat(known.xhat, known.fhat),
        "lower": ca.vertcat(known.x.lower, known.f.lower),
        "upper": ca.vertcat(known.x.upper, known.f.upper),
        "sound": known.sound,
    }
    ends = np.cumsum([0, *(value.numel() for value in outputs.values())]).tolist()
    together = ca.vertsplit(ca.cse(ca.densify(ca.vertcat(*outputs.values()))), ends)
    return ca.Function("core", [memory, u, y], together, ["memory", "u", "y"], [*outputs])


def numbers(observer: ob.Observer, precision: str = "double") -> str:
    """Return the numbers of `by_hand/core.c` as a header."""
    design: Any = observer.certificate.design
    dtype, suffix = (np.float64, "") if precision == "double" else (np.float32, "F")

    def text(value: Any) -> str:
        if isinstance(value, (Sequence, np.ndarray)):
            return "{" + ", ".join(text(entry) for entry in value) + "}"
        return np.format_float_scientific(dtype(value), unique=True, trim="0") + suffix

    def array(name: str, value: Any) -> str:
        size = "".join(f"[{n}]" for n in np.shape(value))
        return f"static const real {name}{size} = {text(value)};"

    # what the third reading corrects is nothing, and K is zero
    assert not design.Z[:, 2].any()
    assert not design.K.any()
    limits, (bound,) = Limits.of(design.extended.plant), running(design)
    value = {sp.Symbol(s.name): s.value for s in design.plant.constants}
    a, A = sp.symbols("a1:5"), sp.symbols("A1:5")
    outflow = [sp.sqrt(2 * sp.Symbol("g")) * a[i] / A[i] for i in range(4)]
    k1, k2, g1, g2 = sp.symbols("k1 k2 gamma1 gamma2")
    pumps = {
        "PUMP1_H1": g1 * k1 / A[0],
        "PUMP2_H2": g2 * k2 / A[1],
        "PUMP1_H4": (1 - g1) * k1 / A[3],
    }
    middle, up = design.middle, precision == "double"
    scalars = {
        **{name: float(sp.N(row.subs(value), 40)) for name, row in pumps.items()},
        "SLOPE_13": middle[0, 2],
        "SLOPE_24": middle[1, 3],
        "ROUND_UP": ROUND_UP if up else 1.0 + SINGLE_UP,
        "ULPS": ULPS if up else SINGLE_UP,
        "ZERO": 0.0,
    }
    arrays = {
        "LIMITS": limits.x,
        "U_LIMITS": limits.u,
        "BOX": design.plant.box("x"),
        "Z": design.Z[:, :2],
        "REACH": bound.reach,
        "ADD": bound.add,
        "DECAY": bound.decay,
        "OUTFLOW": [float(sp.N(row.subs(value), 40)) for row in outflow],
        "SLOPE": middle.diagonal()[:4],
    }
    mathematics = [f"#define {name.upper()} {name}{suffix.lower()}" for name in ("fabs", "sqrt")]
    lines = ["#include <math.h>", *mathematics]
    lines += [f"#define {name} {text(number)}" for name, number in scalars.items()]
    return "\n".join(lines + [array(name, values) for name, values in arrays.items()]) + "\n"


def by_hand(observer: ob.Observer, folder: Path, precision: str = "double") -> Any:
    """Return the step that is written by hand, as a function of a memory (in place), u, y."""
    (folder / "numbers.h").write_text(numbers(observer, precision))
    single = [] if precision == "double" else ["-DSINGLE"]
    library = folder / f"{precision}.so"
    command = ["gcc", *STRICT, *single, "-fPIC", "-shared", f"-I{folder}", f"-I{HAND}"]
    subprocess.run([*command, str(HAND / "core.c"), "-o", str(library), "-lm"], check=True)
    return ctypes.CDLL(str(library)).by_hand_step


def differing(observer: ob.Observer, folder: Path, count: int = 20_000) -> int:
    """How many of the steps by hand are not those of CasADi's function, to the last bit."""
    core, step = core_of(observer), by_hand(observer, folder)
    rng, plant, wrong = np.random.default_rng(1), observer.model, 0
    x, u = plant.box("x"), plant.box("u")
    sizes = [core.numel_in(i) for i in range(3)]
    for k in range(count):
        # a tenth outside of the ranges
        far = 1.0 if k % 10 else 3.0
        p = np.append(x.mean(axis=1) + far * rng.uniform(-0.5, 0.5, 4) * np.ptp(x, axis=1), [0, 0])
        p[4:] = rng.uniform(-3, 3, 2)
        memory = np.append(p, rng.uniform(0, 10, sizes[0] - 6) ** 2)
        data = np.append(u[:, 0] + far * rng.uniform(0, 1, 2) * np.ptp(u, axis=1), p[:3])
        data[2:] += rng.uniform(-1, 1, 3)
        expected = np.concatenate([np.array(v).ravel() for v in core(memory, data[:2], data[2:])])
        out, moved = np.empty(18), memory.copy()
        sound = step(*(ctypes.c_void_p(v.ctypes.data) for v in (moved, data, out)))
        found = np.concatenate([moved, out, [float(sound)]])
        wrong += found.tobytes() != expected.tobytes()
    return wrong


def main() -> int:
    """Compare the step by hand with CasADi's function."""
    observer = four_tanks()
    with tempfile.TemporaryDirectory() as name:
        wrong = differing(observer, Path(name))
        by_hand(observer, Path(name), "single")
    print(f"by hand beside CasADi's function, to the last bit: {wrong} of 20000 steps differ")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
