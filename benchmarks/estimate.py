"""How long does an estimate from a record take, and how much memory?

For every method: microseconds a step, nanoseconds an instruction of it, and the ratio to plain
calls of `observer.step` in the same run. Then a million samples, estimated and written, in a
process of their own: seconds and peak memory.

Usage: python benchmarks/estimate.py [million]
"""

import resource
import subprocess
import sys
import tempfile
import time
from importlib.util import find_spec
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import obsynth as ob


def quiet(observer, count):
    """Return a record of nominal inputs and the readings that they would leave, with some noise."""
    model, scenario = observer.model, ob.scenarios.gentle(observer.model)
    rho = np.array([s.nominal or 0.5 * (s.lower + s.upper) for s in model.rho if s.measured])
    zeros = (np.zeros(len(getattr(model, kind))) for kind in ("d", "f", "w"))
    rest = np.array([s.nominal or 0.5 * (s.lower + s.upper) for s in model.rho])
    p = [s.nominal or 0.5 * (s.lower + s.upper) for s in model.p]
    u = np.array(scenario.inputs[0])
    y = np.array(model.function()(scenario.guess, u, *zeros, p, rest)[1]).ravel()
    noise = np.random.default_rng(0).uniform(-1e-3, 1e-3, (count, len(y)))
    names = {"u": model.names("u"), "y": model.output_names}
    names["rho"] = tuple(s.name for s in model.rho if s.measured)
    return ob.Record(
        time=np.arange(count) * float(model.Ts),
        u=np.tile(u, (count, 1)),
        y=y + noise,
        reference=np.zeros((count, 0)),
        names=names,
        units={key: ("",) * len(value) for key, value in names.items()},
        source="nominal",
        rho=np.tile(rho, (count, 1)),
    )


def seconds(job, times=3):
    """Return the least time of a few on this processor: what others do does not count."""
    taken = []
    for _ in range(times):
        start = time.process_time()
        job()
        taken.append(time.process_time() - start)
    return min(taken)


def speed(count=4000, plain=400):
    """Tabulate what a step costs, of every method."""
    from methods import METHODS, observer_of

    rows = []
    for name in METHODS:
        observer = observer_of(name)
        record, step = quiet(observer, count), observer.step
        small = record[:2]
        whole = seconds(lambda o=observer, r=record: ob.estimate(o, r))
        whole -= seconds(lambda o=observer, r=small: ob.estimate(o, r))
        first = observer.memory0(ob.scenarios.gentle(observer.model).guess)
        given = [record.u[0], record.y[0], *([record.rho[0]] if step.n_in() == 4 else [])]

        def calls(step=step, first=first, given=given):
            memory = first
            for _ in range(plain):
                memory = step(memory, *given)[0]

        each, peer = whole / count, seconds(calls) / plain
        size = step.n_instructions()
        rows.append([name, size, 1e6 * each, 1e9 * each / size, each / peer])
    heads = ["method", "instructions", "us a step", "ns an instruction", "of a plain call"]
    print(ob.Table(f"{count} samples", heads, rows))


def _peak():
    """Return the most MiB that this program has held; what `getrusage` says counts its parent."""
    status = Path("/proc/self/status")
    if status.is_file():
        return int(status.read_text().split("VmHWM:")[1].split()[0]) / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def million(count=1_000_000):
    """Print seconds of the processor and MiB of an estimate that is written."""
    observer = ob.IntervalObserver().design(ob.plants.interval_example())
    record = quiet(observer, count)
    ending = "csv" if find_spec("pyarrow") is None else "parquet"
    start = time.process_time()  # one thread: what others do at the time does not count
    with tempfile.TemporaryDirectory() as folder:
        ob.estimate(observer, record).write(Path(folder, f"told.{ending}"))
    taken = time.process_time() - start
    peak = _peak()
    print(f"{ending} {taken:.1f} {peak:.0f} : seconds and MiB of a million samples")


if __name__ == "__main__":
    if sys.argv[1:] == ["million"]:
        million()
    else:
        speed()
        subprocess.run([sys.executable, __file__, "million"], check=True)
