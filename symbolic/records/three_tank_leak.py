"""A laboratory rig of three water tanks with a real leak, read from the file beside it."""

from pathlib import Path

import numpy as np

from obsynth.symbolic.errors import PlantError
from obsynth.symbolic.record import Record

FILE = Path(__file__).with_suffix(".csv")
OFF, FULL = 0.43, 1.0


def three_tank_leak(start: int = 36) -> Record:
    """Return the record of a leak in tank 2 in the signals of `plants.leaking_tanks`.

    Parameters
    ----------
    start : int
        First sample kept, 0 to 215. Until about 30 tank 1 stands no higher than tank 2, and the
        first start of a pump shows a second of dead time: the square roots hold from 36 on.

    Returns
    -------
    Record
        Samples start..216, 1 s apart: u as shares of the pumps' full range, y in V above the
        readings at rest, and as reference ``pulses``, what a flow meter on the leak counted since
        the start: about 23 a second from sample 61 on, as the leak opens between 60 and 61.

    Raises
    ------
    PlantError
        For a `start` that leaves fewer than two samples.

    Notes
    -----
    By Lejun Hu, MIT licence (``three_tank_leak.LICENSE`` beside the data), from
    github.com/scientificprogrammer123/interconnected-water-tank-system_particle-filter-fault-detection;
    what was cleaned stands in ``three_tank_leak.md``. A quantum of the readings is .0102 V.

    Examples
    --------
    >>> record = three_tank_leak()
    >>> record
    <Record 'three_tank_leak.csv', 181 samples, t = 36 to 216, inputs u1, u3, outputs y1, y2, y3>
    >>> int(record["pulses"][61 - 36]), int(record["pulses"][60 - 36])
    (7, 0)
    """
    table = np.genfromtxt(FILE, delimiter=",", names=True)
    if isinstance(start, bool) or int(start) != start or not 0 <= start < len(table) - 1:
        raise PlantError(
            f"start={start!r} is no sample from 0 to {len(table) - 2} of {FILE.name}", start=start
        )
    readings = np.column_stack([table[name] for name in ("y1", "y2", "y3")])
    duty = np.column_stack([table["u1"], table["u3"]])
    kept = slice(int(start), None)
    return Record(
        time=table["t"][kept],
        u=(duty[kept] - OFF) / (FULL - OFF),
        y=readings[kept] - readings[0],
        reference=table["leak_pulses"][kept, None],
        names={"u": ("u1", "u3"), "y": ("y1", "y2", "y3"), "reference": ("pulses",)},
        units={"u": ("", ""), "y": ("V", "V", "V"), "reference": ("",)},
        source=FILE.name,
    )
