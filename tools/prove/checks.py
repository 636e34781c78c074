"""What one generated project is asked by other people's tools."""

import json
import os
import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from obsynth.designs.core.boxes import LIMITS

HERE = Path(__file__).parent

ADVISORY = frozenset({"2.3", "2.5", "12.1"})
"""Rules of MISRA C:2012 that are advisory and not kept, with reasons in `docs/c.md`."""
WARNINGS = ("-Weverything", "-Wno-declaration-after-statement", "-Wno-float-equal", "-Werror")
GCC = ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-Werror")
SANITIZERS = "fuzzer,address,undefined,float-cast-overflow"
EVA = ("-machdep", "gcc_x86_64", "-eva", "-eva-precision", "1", "-eva-auto-loop-unroll", "1000")
STEPS = 3
"""Of one run of the fuzzer."""


@dataclass(frozen=True)
class Project:
    """A generated project, and rows of memory and inputs that a fuzzer begins from."""

    folder: Path
    name: str
    seeds: np.ndarray

    @property
    def source(self) -> Path:
        """The file that is compiled."""
        return self.folder / "src" / f"{self.name}.c"

    @property
    def manifest(self) -> dict:
        """What the project says of itself."""
        return json.loads((self.folder / "manifest.json").read_text())

    @property
    def precision(self) -> str:
        """Of its numbers."""
        return "single" if self.seeds.dtype == np.float32 else "double"

    @property
    def include(self) -> list[str]:
        """Where headers are."""
        return [f"-I{self.folder / 'include'}", f"-I{self.folder / 'src'}"]


@dataclass(frozen=True)
class Said:
    """What a tool said: how much it found, and some of it."""

    found: int
    text: str = ""

    def __str__(self) -> str:
        return str(self.found)


def ran(command: list[str], **environment: str) -> str:
    """Run a command; return all that it printed."""
    done = subprocess.run(
        command, capture_output=True, text=True, env={**os.environ, **environment}, errors="replace"
    )
    return f"{done.stdout}{done.stderr}\n[exit {done.returncode}]"


def _driver(project: Project, file: str, **parts: str) -> Path:
    text = (HERE / file).read_text().replace("NAME", project.name)
    for word, part in parts.items():
        text = re.sub(rf"^{word}$", part, text, flags=re.M)
    place = project.folder.parent / f"{project.name}_{file}"
    place.write_text(text)
    return place


def eva(project: Project, box: bool = False) -> Said:
    """Count alarms, and preconditions that are not proved, of Frama-C's Eva.

    Over all bit patterns of memory and inputs; with `box`, over the box of the manifest, and an
    operation whose result may be no number is an alarm.
    """
    ends, lines = project.manifest["input_box"], []
    inputs = [pair for port in ("u", "y", "theta") for pair in ends.get(port, [])]
    for array, pairs in (("memory", ends["memory"]), ("given", inputs)):
        for i, (low, high) in enumerate(pairs):
            value = f"Frama_C_double_interval({low!r}, {high!r})" if box else "any"
            lines.append(f"    {array}[{i}] = {value};")
    driver = _driver(project, "eva.c", GIVEN="\n".join(lines))
    special = ["-warn-special-float", "nan" if box else "none"]
    said = ran(["frama-c", f"-cpp-extra-args={' '.join(project.include)}", *EVA, *special, driver])
    summary = re.search(r"^\s*(\d+) alarms? generated", said, re.M)
    told = {
        kind: re.search(rf"{kind}\s+(\d+) valid\s+(\d+) unknown\s+(\d+) invalid", said)
        for kind in ("Assertions", "Preconditions")
    }
    if summary is None or "[exit 0]" not in said:
        return Said(-1, said[-2000:])
    reached = told["Assertions"]
    unknown = sum(int(m[2]) + int(m[3]) for m in told.values() if m)
    # a driver that does not come to its end proves nothing
    stopped = reached is None or int(reached[1]) + int(reached[2]) < 2
    alarms = re.findall(r"\[eva:alarm\][^\n]*\n[^\n]*", said)
    return Said(int(summary[1]) + unknown + stopped, "\n".join(alarms[:3]))


def numbers(project: Project) -> Said:
    """Count results that the generator has not proved to be numbers in order."""
    missing = project.manifest["numbers_in_order"]["not_proved"]
    return Said(len(missing), ", ".join(missing))


def misra(project: Project) -> Said:
    """Count hits of rules of MISRA C:2012 that are not among those that are named."""
    place = project.folder.parent / f"{project.name}_misra"
    shutil.copytree(project.folder, place, dirs_exist_ok=True)
    # without its flow of values, which takes an hour for a long function and no rule needs
    options = ["--addon=misra", "--std=c99", "--quiet", "--force", "--template={file}: {id}"]
    files = [f"-I{place / 'include'}", str(place / "src" / f"{project.name}.c")]
    said = ran(["cppcheck", *options, *files], DISABLE_VALUEFLOW="1")
    hits = re.findall(r"misra-c2012-(\d+\.\d+)", said)
    if not hits or "[exit 0]" not in said:
        return Said(-1, said[-2000:])  # the advisory rules are always hit: the addon has not run
    wrong = [rule for rule in hits if rule not in ADVISORY]
    others = re.findall(r": (?!misra|toomany)(\w+)$", said, re.M)
    return Said(len(wrong) + len(others), ", ".join(sorted({*wrong, *others})))


def compilers(project: Project) -> Said:
    """Count warnings of clang's -Weverything and gcc's analyzer."""
    source, found, text = [str(project.source), *project.include], 0, ""
    for command in (
        ["clang-14", "-std=c99", *WARNINGS, "-O1", "-c", "-o", os.devnull, *source],
        ["gcc", *GCC, "-O1", "-fanalyzer", "-c", "-o", os.devnull, *source],
    ):
        said = ran(command)
        warnings = re.findall(r"(?:error|warning): [^\n]*", said)
        found += len(warnings) or int("[exit 0]" not in said)
        text += "\n".join(warnings[:3])
    return Said(found, text)


def fuzz(project: Project, seconds: int) -> Said:
    """Let libFuzzer look for a memory and inputs for which a step breaks its word."""
    sizes = project.manifest["sizes"]
    known = [
        f"        sound = sound && finite(in.{k}, {n}u);"
        for k, n in sizes.items()
        if k in {"u", "theta"} and n
    ]
    pairs = [("f_lower", "f_upper")] if sizes["f"] else []
    header = (project.folder / "include" / f"{project.name}.h").read_text()
    pairs += [("mean_lower", "mean_upper")] if "mean_lower[" in header else []
    faults = [f"        ordered(out.{a}, out.{b}, {sizes['f']}u);" for a, b in pairs]
    driver = _driver(project, "fuzz.c", KNOWN="\n".join(known), FAULTS="\n".join(faults))
    place = driver.with_suffix("")
    corpus = place.with_name(f"{place.name}_corpus")
    corpus.mkdir(exist_ok=True)
    for i in range(len(project.seeds) - STEPS):
        later = project.seeds[i + 1 : i + STEPS, sizes["memory"] :]
        (corpus / str(i)).write_bytes(project.seeds[i].tobytes() + later.tobytes())
    finite = f"-DFINITE={LIMITS[project.precision].finite!r}"
    flags = [finite, f"-fsanitize={SANITIZERS}", "-fno-sanitize-recover=all", *project.include]
    build = ran(["clang-14", "-std=c99", "-g", "-O1", *flags, str(driver), "-o", str(place), "-lm"])
    if "[exit 0]" not in build:
        return Said(-1, build[-2000:])
    longest = project.seeds.itemsize * (project.seeds.shape[1] * STEPS)
    said = ran(
        [
            str(place),
            f"-max_total_time={seconds}",
            f"-max_len={longest}",
            "-seed=1",
            f"-artifact_prefix={place}_",
            str(corpus),
        ]
    )
    runs = re.search(r"Done (\d+) runs", said)
    if runs is None or "[exit 0]" not in said:
        return Said(1, said[-1500:])
    return Said(0, f"{int(runs[1]):,} runs")
