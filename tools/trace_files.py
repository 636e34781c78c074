"""Count the files of the package that a call walks through.

A file counts when one of its functions is entered while the call runs, not when it is imported:
comprehensions, lambdas and generated methods count for the file that holds them. The process is
warm (every call has run once, on a plant of its own) and the plant fresh, so that neither
imports nor results kept from before decide.

    python tools/trace_files.py --root OLDER_CHECKOUT    # that one, this one, and the ratio
    python tools/trace_files.py --list generate_c        # the files that one call walks through
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from importlib import import_module
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

HERE = Path(__file__).resolve().parents[1]
ROOMS = ("symbolic", "derive", "designs", "codegen", "evaluate", "src")


def walked(call: Callable[[], Any], root: Path) -> list[str]:
    """Return the files below `root` in which a function is entered during a call."""
    codes: set[CodeType] = set()

    def entered(frame: FrameType, event: str, _: object) -> None:
        if event == "call":
            codes.add(frame.f_code)

    sys.setprofile(entered)
    try:
        call()
    finally:
        sys.setprofile(None)
    # The rooms are reached through links; class bodies are run while a module is imported.
    paths = {Path(os.path.realpath(c.co_filename)) for c in codes if c.co_name != "<module>"}
    below = {p.relative_to(root).as_posix() for p in paths if p.is_relative_to(root)}
    return sorted(p for p in below if p.endswith(".py") and p.split("/", 1)[0] in ROOMS)


def calls(root: Path) -> dict[str, list[str]]:
    """Run every call twice, on two plants, and trace the second time."""
    import obsynth as ob

    assert Path(os.path.realpath(ob.__file__)).is_relative_to(root), ob.__file__
    project: Any = import_module("obsynth.codegen.project")
    found: dict[str, list[str]] = {}

    def trace(name: str, call: Callable[[], Any]) -> Any:
        kept: list[Any] = []
        found[name] = walked(lambda: kept.append(call()), root)
        return kept[0]

    with tempfile.TemporaryDirectory() as place:
        stored = Path(place, "design.json")
        for turn in ("cold", "warm"):
            tank = ob.plants.quadruple_tank().discretise("euler", Ts=1.0)
            design = partial(ob.BoundedErrorUIO(gamma=0.005).design, tank)
            trace("BoundedErrorUIO.design", design).save(stored)
            trace('check("lmi")', partial(ob.load(stored).certificate.check, "lmi"))
            trace("check()", ob.load(stored).certificate.check)
            example = ob.plants.interval_example()
            trace("IntervalObserver.design", partial(ob.IntervalObserver().design, example))
            built, plain = Path(place, f"{turn} built"), Path(place, f"{turn} plain")
            trace("generate_c", partial(ob.generate_c, ob.load(stored), built))
            compiler, project.find_compiler = project.find_compiler, lambda: None
            trace("generate_c, not built", partial(ob.generate_c, ob.load(stored), plain))
            project.find_compiler = compiler
    return found


def measured(root: Path) -> dict[str, list[str]]:
    """Trace a checkout in a process of its own."""
    environment = {**os.environ, "PYTHONPATH": str(root / "src")}
    command = [sys.executable, str(Path(__file__).resolve()), "--measure", str(root)]
    done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout)


def main() -> None:
    """Print how many files each call walks through."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--root", type=Path, default=HERE, help="a checkout to compare with")
    parser.add_argument("--list", metavar="CALL", help="list the files of calls named so")
    parser.add_argument("--measure", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.measure is not None:
        print(json.dumps(calls(options.measure.resolve())))
        return
    new = measured(HERE)
    if options.list:
        for name, files in new.items():
            if options.list in name:
                print(f"{name}: {len(files)}", *files, sep="\n  ")
        return
    root = options.root.resolve()
    old = new if root == HERE else measured(root)
    print(f"{'files walked through by':26}{root.name:>12}{HERE.name:>8}{'ratio':>8}")
    for name, files in old.items():
        count = len(new[name])
        print(f"{name:26}{len(files):12}{count:8}{count / len(files):8.0%}")


if __name__ == "__main__":
    main()
