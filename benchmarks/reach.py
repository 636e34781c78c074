"""How far do the methods reach, at the first try, on plants as people type them?

Every plant with every method at its defaults: certified or not, half widths of faults and states
as shares of their half ranges, seconds from the typed plant to the proved observer, or the first
sentence of the refusal. Each try has a process of its own, which is ended after some seconds.

Usage: python benchmarks/reach.py [seconds for each try, 60] [part of a plant] [part of a method]
"""

import multiprocessing
import re
import sys
import time

import numpy as np

import obsynth as ob
from obsynth.symbolic import Table

PLANTS = {
    "cruise_control": 0.1,
    "pvtol": 0.02,
    "cart_pole": 0.01,
    "flexible_joint": 0.01,
    "dc_motor": 0.01,
    "battery": 1.0,
    "kinematic_bicycle": 0.05,
    "heat_exchanger": 0.2,
    "surface_pmsm": 1e-4,
    "klatt_engell_reactor": 0.001,
    "forced_oscillator": 0.01,
    "tanks_in_a_row": 0.5,
}
"""Sample times, s (h for the reactor)."""
METHODS = {
    "ellipsoid": (ob.BoundedErrorUIO, {}),
    "peak": (ob.BoundedErrorUIO, {"bounds": "peak"}),
    "l2": (ob.HinfUIO, {}),
    "interval": (ob.IntervalObserver, {}),
    "set adaptive": (ob.SetAdaptiveObserver, {}),
    "bank": (ob.FilterBank, {}),
    "qpv": (ob.QPVObserver, {}),
}
DISCRETE = ("ellipsoid", "peak", "l2", "interval")
USEFUL = 0.95
"""Of a half range: narrower ones tell something."""


def tried(plant, method, send):
    """Design in a process of its own and send what came of it."""
    kind, options = METHODS[method]
    start = time.perf_counter()
    try:
        model, Ts = getattr(ob.plants, plant)(), PLANTS[plant]
        if method in DISCRETE:
            observer = kind(**options).design(model.discretise("euler", Ts=Ts))
        else:
            observer = kind(**options, Ts=Ts).design(model)
        assert observer.certificate.valid
    except ob.ObsynthError as refusal:
        send.send((None, type(refusal).__name__, str(refusal)))
        return
    except Exception as error:  # a bug: told apart from refusals
        send.send((None, f"BUG {type(error).__name__}", str(error)))
        return
    seconds = time.perf_counter() - start
    shares = np.full(len(model.x) + len(model.f), np.inf)
    if observer.half_widths is not None:
        boxes = np.vstack([observer.model.box("x"), observer.model.box("f").reshape(-1, 2)])
        shares = observer.half_widths / (0.5 * np.diff(boxes, axis=1)[:, 0])
    n = len(model.x)
    send.send((seconds, shares[n:].tolist(), float(shares[:n].max())))


def attempt(plant, method, limit):
    """Return what `tried` sends, or that it took too long."""
    receive, send = multiprocessing.Pipe(duplex=False)
    process = multiprocessing.get_context("fork").Process(target=tried, args=(plant, method, send))
    process.start()
    send.close()
    try:
        return receive.recv() if receive.poll(limit) else (None, "time", f"no answer in {limit} s")
    except EOFError:
        return None, "BUG", f"the process ended with {process.exitcode}"
    finally:
        process.kill()
        process.join()


def first_sentence(text):
    """Return the beginning of a refusal, in one line."""
    line = " ".join(text.split())
    return re.split(r"(?<=[a-z)\]0-9])[.;] ", line, maxsplit=1)[0][:110]


def line(plant, method, limit):
    """Return the row of a try, and whether it is certified and useful."""
    seconds, faults, states = attempt(plant, method, limit)
    if seconds is None:
        return [plant, method, "no", "", "", "", f"{faults}: {first_sentence(states)}"], (0, 0)
    shares = " ".join(f"{share:.3f}" if np.isfinite(share) else "-" for share in faults)
    shown = f"{states:.3f}" if np.isfinite(states) else "-"
    useful = bool(faults) and min(faults) < USEFUL
    return [plant, method, "yes", shares, shown, f"{seconds:.1f}", ""], (1, int(useful))


def main(limit=60, part="", kind=""):
    """Try all pairs, show each as it ends, then the table with totals."""
    rows, totals, start = [], {}, time.perf_counter()
    for plant in (name for name in PLANTS if part in name):
        for method in (name for name in METHODS if kind in name):
            row, count = line(plant, method, limit)
            rows.append(row)
            totals[method] = np.add(totals.get(method, (0, 0, 0)), (*count, 1))
            print(" | ".join(row), file=sys.stderr, flush=True)
    heads = ["plant", "method", "certified", "faults", "states, max", "s", "reason"]
    title = "Half widths as shares of half ranges, at the first try"
    print(Table(title, heads, rows))
    counts = [[name, *map(int, totals[name])] for name in totals]
    counts.append(["all", *map(int, sum(totals.values()))])
    print(Table("Pairs", ["method", "certified", "useful fault interval", "tried"], counts))
    print(f"{time.perf_counter() - start:.0f} s")


if __name__ == "__main__":
    main(*(int(a) if a.isdigit() else a for a in sys.argv[1:]))
