"""Cortex-M boards under QEMU: build a C step for one, run it there, measure."""

import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from libgcc import soft_sum

from obsynth.codegen.description import describe
from obsynth.codegen.kernel import DOUBLE, RESULTS
from obsynth.codegen.lanes import Lanes
from obsynth.codegen.vectors import as_ports, record

HERE = Path(__file__).parent
FLAGS = ("-Wall", "-Wextra", "-Werror", "-O2")
CORES: Mapping[str, tuple[str, tuple[str, ...]]] = {
    "M3": ("mps2-an385", ("-mcpu=cortex-m3", "-mfloat-abi=soft")),
    "M4F": ("mps2-an386", ("-mcpu=cortex-m4", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard")),
    "M7": ("mps2-an500", ("-mcpu=cortex-m7", "-mfpu=fpv5-d16", "-mfloat-abi=hard")),
}
"""Boards of QEMU and flags of the compiler; M3 has no FPU, that of M4F has no double."""
SOFT = ("M3", "M4F")
"""Where operations on doubles are those of GCC's library."""

TICK, TURNS = 40, 100_000
"""Instructions a tick of SysTick (25 MHz, one instruction a nanosecond), turns of the loop."""
RECORDS, TIMED = 256, 64
"""Steps, and over how many of them, the first ones, instructions are counted."""
_NOTHING = 2
_REPORT = 6


@dataclass(frozen=True, eq=False)
class Ran:
    """What a step does on a board.

    found: outputs, status, next memory of every record, (N, n)
    instructions: of one call, mean over the timed records, between entry and return
    stack: bytes below the caller, those of the libraries included
    text: bytes of code and constants of the step alone
    selftest: the first step of the project's own test that differs, 0 if none does
    """

    found: np.ndarray
    instructions: float
    stack: int
    text: int
    selftest: int


def _first_line(program: str) -> str:
    done = subprocess.run([program, "--version"], capture_output=True, text=True, check=True)
    return done.stdout.splitlines()[0]


def compiler() -> str:
    """Return name and version of the compiler."""
    return _first_line("arm-none-eabi-gcc")


def emulator() -> str:
    """Return name and version of the emulator."""
    return _first_line("qemu-system-arm")


def run(
    core: str,
    name: str,
    sources: Sequence[Path],
    include: Sequence[Path],
    records: np.ndarray,
    width: int,
    std: str = "gnu17",
) -> Ran:
    """Build and run the steps of one project on one board.

    sources: the step, and what has ``NAME_selftest`` where there is one
    records: states and inputs (N, n), of the project's type
    width: how many numbers a step returns
    std: with GNU's extensions the compiler may fuse operations, where the source lets it
    """
    board, machine = CORES[core]
    build = [
        "arm-none-eabi-gcc",
        f"-std={std}",
        *machine,
        *FLAGS,
        *(f"-I{path.absolute()}" for path in include),
    ]
    told = [f'-DPROJECT="{name}.h"', f"-DNAME={name}", f"-DTIMED={TIMED}"]
    told += ["-DSELFTEST"] if len(sources) > 1 else []
    script = ["-nostartfiles", "-T", str(HERE / "mps2.ld")]
    emulate = ["qemu-system-arm", "-M", board, "-nographic", "-monitor", "none", "-serial", "none"]
    with tempfile.TemporaryDirectory(prefix="obsynth-firmware-") as place:
        (Path(place) / "records.bin").write_bytes(np.ascontiguousarray(records).tobytes())

        def call(*command: str) -> str:
            done = subprocess.run(
                command, cwd=place, capture_output=True, text=True, timeout=300, check=False
            )
            if done.returncode:
                said = (done.stdout + done.stderr).strip()
                raise RuntimeError(
                    f"{name}, {core}: {command[0]} ends with {done.returncode} {said}"
                )
            return done.stdout

        objects = [f"{source.stem}.o" for source in sources]
        for source, built in zip(sources, objects, strict=True):
            call(*build, "-c", str(source.absolute()), "-o", built)
        text = int(call("arm-none-eabi-size", objects[0]).splitlines()[1].split()[0])
        call(*build, *told, *script, str(HERE / "main.c"), *objects, "-lm", "-o", "firmware.elf")
        call(*emulate, "-icount", "shift=0", "-semihosting", "-kernel", "firmware.elf")
        raw = (Path(place) / "results.bin").read_bytes()
    head = 4 * _REPORT
    loop, nothing, step, stack, modes, selftest = np.frombuffer(raw[:head], np.uint32).tolist()
    # two instructions a turn
    if abs(loop * TICK - 2 * TURNS) > 2 * TICK:
        raise RuntimeError(f"{core}: {2 * TURNS} instructions are counted as {loop * TICK}")
    if modes:
        raise RuntimeError(f"{core}: the FPU flushes, or rounds in another way: FPSCR {modes:#x}")
    found = np.frombuffer(raw[head:], records.dtype).reshape(len(records), width)
    instructions = (step - nothing) * TICK / TIMED + _NOTHING
    return Ran(found, instructions, stack, text, selftest)


def apart(expected: np.ndarray, found: np.ndarray) -> np.ndarray:
    """Return how many numbers of the type lie between; 0 for two NaN, at least 1 for two zeros."""
    whole = np.dtype(f"i{expected.dtype.itemsize}")
    a, b = (np.ascontiguousarray(v).view(whole).astype(object) for v in (expected, found))
    most = np.iinfo(whole).max
    a, b = (np.where(v < 0, ~(v & most), v) for v in (a, b))
    both = np.isnan(expected) & np.isnan(found)
    return np.where(both, 0, np.abs(a - b)).astype(float)


def recorded(observer: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return states with inputs, and what a step makes of them: as vectors are, healthy ones first.

    On CasADi's machine, or on NumPy's float32.
    """
    description = describe(observer)
    steps = record(description, RECORDS, 0)[0].steps
    steps.sort(key=lambda step: step.status != 0)
    given = [np.concatenate([step.before, step.inputs]) for step in steps]
    made = [np.concatenate([step.results, [step.status], step.after]) for step in steps]
    return np.array(given, description.real.type), np.array(made, description.real.type)


def softened(observer: Any, records: np.ndarray) -> np.ndarray:
    """Return what a step in doubles makes of records where its sums are those of GCC's library."""
    description, count = describe(observer), observer.step.numel_in("memory")
    instead = {"add": soft_sum, "sub": lambda a, b: soft_sum(a, -b)}
    lanes = Lanes(observer.step, DOUBLE, instead)
    found = lanes.run(as_ports(description, [(row[:count], row[count:]) for row in records]))
    # status and next memory stand behind the others
    behind = [RESULTS.index("status"), RESULTS.index("next")]
    told = sorted(lanes.results, key=lambda r: (r[0] in behind and 1 + behind.index(r[0]), r[:2]))
    return np.array([found[k] for *_, k in told]).T
