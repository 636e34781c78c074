"""A record with everything that goes wrong, of a plant that has a range on everything."""

from dataclasses import dataclass

import numpy as np
from gallery import TIMES
from numpy.typing import NDArray

import obsynth as ob


@dataclass(frozen=True)
class Damaged:
    """A record, the rows it was read from, the truth (N, ...), and what was done to which rows."""

    plant: ob.Plant
    source: dict[str, NDArray[np.float64]]
    record: ob.Record
    x: NDArray[np.float64]
    f: NDArray[np.float64]
    gaps: tuple[slice, ...]
    missing: tuple[str, slice]
    stuck: tuple[str, slice]
    outlier: tuple[str, int]


def damaged_record(seed: int = 0, count: int = 400) -> Damaged:
    """Three tanks in a row, quantised readings, a pump that loses a fifth of its flow.

    Two gaps without rows while the pump is held, y3 unplugged for a while, y2 stuck, an outlier
    in y1. Everything else keeps the plant's ranges, noise and quantisation together.
    """
    plant = ob.plants.tanks_in_a_row().discretise("euler", Ts=TIMES["tanks_in_a_row"])
    rng, step, quantum = np.random.default_rng(seed), plant.function(), 0.01
    k = np.arange(count)
    u = np.round(1 + 0.15 * rng.uniform(-1, 1, count)[k // 25 * 25], 3)[:, None]
    rate = 0.5 * min(s.rate or 0.0 for s in plant.f)
    f = -np.clip(rate * (k - 200), 0, 0.2)[:, None]
    x, y = np.zeros((count, 3)), np.zeros((count, 3))
    x[0] = rng.uniform(7.5, 8.5, 3)
    for i in k:
        noise = rng.uniform(-0.05 + quantum / 2, 0.05 - quantum / 2, 3)
        moved, shown = (v.full()[:, 0] for v in step(x[i], u[i], [], f[i], noise, [], []))
        y[i] = np.round(shown / quantum) * quantum
        if i + 1 < count:
            x[i + 1] = moved
    gaps = (slice(82, 90), slice(331, 334))
    missing, stuck, outlier = ("y3", slice(120, 160)), ("y2", slice(240, 280)), ("y1", 310)
    y[missing[1], 2] = np.nan
    y[stuck[1], 1] = y[stuck[1].start, 1]
    y[outlier[1], 0] += 3
    kept = np.delete(k, np.concatenate([k[gap] for gap in gaps]))
    columns = {"t": kept * 0.5, "pump": u[kept, 0], **{f"y{j + 1}": y[kept, j] for j in range(3)}}
    record = ob.read_record(columns, plant, map={"v": "pump"})
    return Damaged(plant, columns, record, x, f, gaps, missing, stuck, outlier)
