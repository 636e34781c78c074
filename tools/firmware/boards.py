"""Cortex-M boards under QEMU: build a C step for one, run it there, measure."""

import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
FLAGS = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off", "-O2")
CORES: Mapping[str, tuple[str, tuple[str, ...]]] = {
    "M3": ("mps2-an385", ("-mcpu=cortex-m3", "-mfloat-abi=soft")),
    "M4F": ("mps2-an386", ("-mcpu=cortex-m4", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard")),
    "M7": ("mps2-an500", ("-mcpu=cortex-m7", "-mfpu=fpv5-d16", "-mfloat-abi=hard")),
}
"""Boards of QEMU and flags of the compiler; M3 has no FPU, that of M4F has no double."""

TICK, TURNS = 40, 100_000
"""Instructions a tick of SysTick (25 MHz, one instruction a nanosecond), turns of the loop."""
_NOTHING = 2
_REPORT = 5


@dataclass(frozen=True, eq=False)
class Ran:
    """What a step does on a board.

    found: outputs, status, next memory of every record, (N, n)
    instructions: of one call, mean over the timed records, between entry and return
    stack: bytes below the caller, those of the libraries included
    text: bytes of code and constants of the project alone
    """

    found: np.ndarray
    instructions: float
    stack: int
    text: int


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
    timed: int,
) -> Ran:
    """Build and run the steps of one project on one board.

    records: states and inputs (N, n), of the project's type
    width: how many numbers a step returns
    timed: over how many records, the first ones, instructions are counted
    """
    board, machine = CORES[core]
    build = ["arm-none-eabi-gcc", *machine, *FLAGS, *(f"-I{path.absolute()}" for path in include)]
    told = [f'-DPROJECT="{name}.h"', f"-DNAME={name}", f"-DTIMED={timed}"]
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
        sizes = call("arm-none-eabi-size", *objects).splitlines()[1:]
        call(*build, *told, *script, str(HERE / "main.c"), *objects, "-lm", "-o", "firmware.elf")
        call(*emulate, "-icount", "shift=0", "-semihosting", "-kernel", "firmware.elf")
        raw = (Path(place) / "results.bin").read_bytes()
    text = sum(int(line.split()[0]) for line in sizes)
    loop, nothing, step, stack, modes = np.frombuffer(raw[: 4 * _REPORT], np.uint32).tolist()
    # two instructions a turn
    if abs(loop * TICK - 2 * TURNS) > 2 * TICK:
        raise RuntimeError(f"{core}: {2 * TURNS} instructions are counted as {loop * TICK}")
    if modes:
        raise RuntimeError(f"{core}: the FPU flushes, or rounds in another way: FPSCR {modes:#x}")
    found = np.frombuffer(raw[4 * _REPORT :], records.dtype).reshape(len(records), width)
    return Ran(found, (step - nothing) * TICK / timed + _NOTHING, stack, text)


def apart(expected: np.ndarray, found: np.ndarray) -> np.ndarray:
    """Return how many numbers of the type lie between; 0 for two NaN, at least 1 for two zeros."""
    whole = np.dtype(f"i{expected.dtype.itemsize}")
    a, b = (np.ascontiguousarray(v).view(whole).astype(object) for v in (expected, found))
    most = np.iinfo(whole).max
    a, b = (np.where(v < 0, ~(v & most), v) for v in (a, b))
    both = np.isnan(expected) & np.isnan(found)
    return np.where(both, 0, np.abs(a - b)).astype(float)
