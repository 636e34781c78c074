"""The box of memories and inputs that a manifest tells."""

import numpy as np
import pytest

from methods import observer_of
from obsynth.codegen.box import input_box
from obsynth.codegen.description import describe


@pytest.mark.parametrize("name", ["luenberger", "qpv_observer"])
def test_the_box_holds_what_a_step_reads_along_the_plant(name):
    """Mutants: ends of a column in the other order, declared ranges left out, first steps alone."""
    description = describe(observer_of(name))
    box = input_box(description)
    assert list(box) == ["memory", "u", "y", "theta"][: len(box)]
    ends = {name: np.array(pairs) for name, pairs in box.items()}
    assert all(np.isfinite(pairs).all() for pairs in ends.values())
    assert all(np.all(pairs[:, 0] <= pairs[:, 1]) for pairs in ends.values())
    held = np.clip(description.start, -np.finfo(float).max, np.finfo(float).max)
    assert np.all((ends["memory"][:, 0] <= held) & (held <= ends["memory"][:, 1]))
    assert ends["u"].tolist() == [[port.lower, port.upper] for port in description.u]
    layout = description.observer.memory_layout
    assert ends["memory"][layout["initialised"]].tolist() == [[1.0, 1.0]]
    assert ends["memory"][layout["age"]].tolist() == [[0.0, 49.0]]
    assert np.all(np.diff(ends["y"], axis=1) > 0)
