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

    Notes
    -----
    By Lejun Hu, MIT licence (``three_tank_leak.LICENSE`` beside the data), from
    github.com/scientificprogrammer123/interconnected-water-tank-system_particle-filter-fault-detection;
    what was cleaned stands in ``three_tank_leak.md``. A quantum of the readings is .0102 V.

    Examples
    --------
    >>> three_tank_leak()
    <Record 'three_tank_leak.csv', 181 samples, inputs u1, u3, outputs y1, y2, y3>
    """
    table = np.genfromtxt(FILE, delimiter=",", names=True)
    if start not in range(len(table) - 1):
        raise PlantError(f"start={start!r} is no sample from 0 to {len(table) - 2}", start=start)
    readings = np.column_stack([table[name] for name in ("y1", "y2", "y3")])
    duty = np.column_stack([table["u1"], table["u3"]])
    return Record(
        time=table["t"][start:],
        u=(duty[start:] - OFF) / (FULL - OFF),
        y=readings[start:] - readings[0],
        reference=table["leak_pulses"][start:, None],
        names={"u": ("u1", "u3"), "y": ("y1", "y2", "y3"), "reference": ("pulses",)},
        units={"u": ("", ""), "y": ("V", "V", "V"), "reference": ("",)},
        source=FILE.name,
    )
