"""A function as compiled code where that pays: the same bits, several times as fast."""

import hashlib
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

import casadi as ca
import numpy as np

from obsynth.codegen.build import find_compiler
from obsynth.codegen.errors import BuildError
from obsynth.codegen.kernel import Call
from obsynth.symbolic.arrays import FloatArray

CACHE = "OBSYNTH_CACHE"
"""Environment variable of the folder of compiled steps; ``~/.cache/obsynth`` without it."""
PAYS = 50_000
"""Calls from which on compiling a function takes less time than it saves, whatever its length."""
FLAGS = ("-O1", "-ffp-contract=off", "-fPIC", "-shared")
_SECONDS = 600
_PROBES = 40


def compiled(function: ca.Function, calls: int) -> ca.Function:
    """Return a function as compiled code, if it was compiled before or will be called often.

    It is compiled once and kept under the hash of what it computes; where there is no compiler,
    no place to keep it or any bit that differs from CasADi's virtual machine, it stays as it is.
    """
    try:
        command = find_compiler()
        plain = function if function.is_a("SXFunction") else function.expand()
    except (BuildError, RuntimeError):
        return function
    if command is None or not _plain(plain):
        return function
    text = f"{ca.CasadiMeta.version()} {command} {FLAGS} {plain.serialize()}"
    try:
        library = _folder() / f"{hashlib.sha256(text.encode()).hexdigest()[:32]}.so"
        if not library.is_file():
            if calls < PAYS:
                return function
            _compile(plain, library, command)
        found = ca.external(plain.name(), str(library))
    except (OSError, subprocess.SubprocessError, RuntimeError):
        return function
    return found if _equal(function, found) else function


def _plain(function: ca.Function) -> bool:
    """Whether a function is scalar operations throughout."""
    codes = (function.instruction_id(k) for k in range(function.n_instructions()))
    return ca.OP_CALL not in codes


def _folder() -> Path:
    given = os.environ.get(CACHE)
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return Path(given) if given else home / "obsynth"


def _compile(function: ca.Function, library: Path, command: tuple[str, ...]) -> None:
    """Compile a function beside its place, and put it there when it is complete."""
    library.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=library.parent) as folder:
        generator = ca.CodeGenerator("step", {"with_header": False})
        generator.add(function)
        source, built = Path(folder) / "step.c", Path(folder) / "step.so"
        source.write_text(generator.dump(), encoding="utf-8")
        subprocess.run(
            [*command, *FLAGS, str(source), "-o", str(built), "-lm"],
            check=True,
            capture_output=True,
            timeout=_SECONDS,
        )
        shutil.move(built, library)


def _equal(function: ca.Function, other: ca.Function) -> bool:
    """Compare both at points of many magnitudes, to the last bit."""
    rng, calls = np.random.default_rng(0), (Call(function), Call(other))
    for k in range(_PROBES):
        told: list[bytes] = []
        for argument in calls[0].args:
            argument[:] = rng.standard_normal(argument.size) * 10.0 ** rng.uniform(-3, 3)
            argument[rng.random(argument.size) < 0.02 * (k % 3)] = rng.choice([0.0, np.nan, np.inf])
        for call in calls:
            for mine, given in zip(call.args, calls[0].args, strict=True):
                mine[:] = given
            call.evaluate()
            told.append(b"".join(_bits(result) for result in call.results))
        if told[0] != told[1]:
            return False
    return True


def _bits(values: FloatArray) -> bytes:
    """Return the bits of numbers, one NaN like another."""
    return np.where(np.isnan(values), np.nan, values).tobytes()
