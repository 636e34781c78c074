"""Many calls in one give what one call after the other gives."""

import casadi as ca
import numpy as np
import pytest

from obsynth.evaluate import march as module
from obsynth.evaluate.march import in_rows, march


def rotation() -> ca.Function:
    state, push, gain = ca.SX.sym("x", 2), ca.SX.sym("u", 2), ca.SX.sym("g")
    turned = ca.vertcat(0.6 * state[0] - 0.8 * state[1], 0.8 * state[0] + 0.6 * state[1])
    told = (ca.sin(state[0]), gain * state + push)
    return in_rows(ca.Function("turn", [state, push, gain], [turned * gain + push, *told]))


@pytest.mark.parametrize("rows", [1, 2, 63, 64, 65, 131])
@pytest.mark.parametrize("together", [True, False])
def test_blocks_are_bits_of_single_calls(rows, together, monkeypatch):
    """Mutants: a block begins with the state before the last; results of filled rows kept."""
    monkeypatch.setattr(module, "BLOCK", 70)
    turn, state = rotation(), np.array([1.0, 0.3])
    signals = np.random.default_rng(3).uniform(0.5, 1.0, (rows, 3))
    asked = []

    def before(k, state, row):
        asked.append((k, *state))
        row[0] = 0.25 * k

    expected, at = [], state.copy()
    for k, row in enumerate(signals):
        given = row if together else np.array([0.25 * k, *row[1:]])
        following, told = turn(at, given)
        expected.append((at, np.array(told).ravel()))
        at = np.array(following).ravel()
    found = list(march(turn, state, signals, None if together else before))
    assert [len(part) for part, _ in found] == [min(70, rows - k) for k in range(0, rows, 70)]
    for column, parts in enumerate(zip(*found, strict=True)):
        assert np.concatenate(parts).tolist() == [list(pair[column]) for pair in expected]
    assert state.tolist() == at.tolist()
    assert asked == ([] if together else [(k, *pair[0]) for k, pair in enumerate(expected)])
