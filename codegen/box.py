"""The box of memories and inputs over which what is generated can be analysed."""

import numpy as np

from obsynth.codegen.description import Description
from obsynth.codegen.drive import Drive
from obsynth.codegen.kernel import STEP_INPUTS
from obsynth.codegen.single import machine_of

_SEQUENCES, _LENGTH = 4, 50


def input_box(description: Description) -> dict[str, list[list[float]]]:
    """Return ends of ``memory, u, y, theta``: around trajectories of the plant, and as declared."""
    step = machine_of(description.observer.step, description.real)
    drive, found = Drive(description, np.random.default_rng(0)), []
    for _ in range(_SEQUENCES):
        begun = drive.begin(_LENGTH)
        memory = description.start if begun is None else begun
        for k in range(_LENGTH):
            inputs = drive.sample(k)
            found.append([memory, *inputs])
            memory = step(memory, *inputs)[0]
    box: dict[str, list[list[float]]] = {}
    ports = {"u": description.u, "theta": description.theta}
    for name, *columns in zip(STEP_INPUTS, *found, strict=False):
        rows = np.clip(np.array(columns, dtype=float), -np.finfo("f8").max, np.finfo("f8").max)
        ends = np.column_stack([np.nanmin(rows, axis=0), np.nanmax(rows, axis=0)])
        for i, port in enumerate(ports.get(name, ())):
            declared = np.array([port.lower, port.upper])
            ends[i] = np.where(np.isfinite(declared), declared, ends[i])
        box[name] = ends.tolist()
    return box
