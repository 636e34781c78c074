"""What rounding adds to the intervals of the QPV observer, and what holding readings means."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from tapes import errors

from methods import METHODS
from obsynth.designs.core.core import Seen
from obsynth.designs.qpv import claims as proofs
from obsynth.designs.qpv import step as module
from obsynth.designs.qpv.guarantee import guarantee
from obsynth.designs.qpv.step import Allowance, allowance, build_update

ENTRY = METHODS["qpv_observer"]


@pytest.fixture(scope="module")
def observer():
    return ENTRY.method.design(ENTRY.plant())


@pytest.fixture(scope="module")
def design(observer):
    return observer.certificate.design


def test_one_step_is_rounded_by_less_than_the_allowance_counts(design):
    """Against 300 bits, at states of X and errors of E. Mutant: half the unit roundoff."""
    rng = np.random.default_rng(0)
    plant, count = design.plant, 300
    half = design.region.half_widths + np.sqrt(design.inverse_diagonal)
    state = design.region.c[:, None] + half[:, None] * rng.uniform(-1, 1, (len(half), count))
    y = state[:1] + rng.normal(size=(1, count))
    u = rng.uniform(*plant.box("u").T[:, :, None], (1, count))
    theta = rng.uniform(0, 1, (1, count))
    delta = errors(build_update(design), [state, u, y, theta], "double")
    seen = np.sqrt(np.einsum("ik,ij,jk->k", delta, design.P, delta)).max()
    assert allowance(design).proved
    assert 0 < seen <= allowance(design).rho < 30 * seen


def test_the_allowance_holds_what_all_steps_add(design):
    """Root of V, moved by rho after every sample. Mutants: rho of one step alone, exp(-rate Ts)
    in place of its root."""
    share = np.exp(-design.noise.rate * design.Ts)
    rho = allowance(design).rho
    for first in (0.0, 0.3, 1.0):
        level, root = first**2, first
        for _ in range(5000):
            level = 1 - share + share * level
            root = np.sqrt(1 - share + share * root**2) + rho
            assert root <= np.sqrt(level) + allowance(design).value * (1 + 1e-3)
    # and most of it is needed where nothing drives V
    root = 0.0
    for _ in range(20_000):
        root = np.sqrt(share) * root + rho
    assert 0.9 * allowance(design).value < root <= allowance(design).value


def test_the_error_set_has_room_for_it(design, monkeypatch):
    """Mutant: a claim about E itself."""
    assert proofs._rounding(design).holds
    monkeypatch.setattr(proofs, "allowance", lambda _: Allowance(0.25, True))
    assert not proofs._rounding(design).holds


def test_no_bound_is_an_assumption_that_is_said(design):
    """A gain that rounds too much: the design is not refused for it."""
    wild = replace(design, L=design.L * 2.0**45)
    assert not allowance(wild).proved
    assert "which is not proved" in guarantee(wild).assumptions[1]
    assert "rounding" not in {claim.name for claim in proofs.claims(wild)}


def test_a_reading_that_is_held_counts_as_a_disturbance(observer, design):
    """The motion that the guarantee of the step names: y_k = x(t) + w(t) all through a sample.

    Mutant: a disturbance that leaves its range to explain the reading (y_k off by .05).
    """
    step, plant = observer.step, design.plant
    rng = np.random.default_rng(4)

    def missed(spread):
        x, f, theta, u, h = 5.03, 0.03, 0.4, 7.0, design.Ts
        memory = observer.memory0([5.0], x_range=[(4.95, 5.05)], f_range=[(-0.05, 0.05)])
        outside, quiet = 0, 0
        for k in range(700):
            y = x + spread * (1.0 if k % 400 < 200 else -1.0) * rng.uniform(0.7, 0.9)
            found = step(memory=memory, u=u, y=y, theta=theta)
            quiet += int(float(found["status"]) == 0)
            low, high = float(found["x_lower"]), float(found["x_upper"])
            inside = float(found["f_lower"]) <= f <= float(found["f_upper"])
            outside += int(not (low <= x <= high and inside))
            memory = found["memory_next"]
            # x' = -(1 + theta) x + f x + u + w with w = y - x, held y, in closed form
            a, b = -(1 + theta) + f - 1, u + y
            x = (x + b / a) * np.exp(a * h) - b / a
            assert spread > 0.01 or abs(y - x) <= plant.box("w")[0, 1]
        return outside, quiet

    outside, quiet = missed(0.01)
    assert (outside, quiet) == (0, 700)
    assert missed(0.05)[0] > 0


@pytest.mark.parametrize("level", [0.0, 0.25, 1.0])
def test_intervals_are_wider_by_the_allowance(design, monkeypatch, level):
    """sqrt(V) + allowance times the half widths of E. Mutants: taken off; ends as rounded."""
    monkeypatch.setattr(module, "allowance", lambda _: Allowance(1e-3, True))
    state, n = design.region.c, len(design.plant.x)
    parts = {"xhat": state[:n], "fhat": state[n:], "level": level}
    seen = Seen(
        {k: ca.SX(ca.DM(v)) for k, v in parts.items()}, *map(ca.SX, (7.0, 0.4, state[0])), [1]
    )
    known = module.build_core(design).run(seen)
    ends = ca.vertcat(known.x.lower, known.f.lower, known.x.upper, known.f.upper)
    low, high = np.array(ca.evalf(ends)).reshape(2, -1)
    wanted = (np.sqrt(level) + 1e-3) * np.sqrt(design.inverse_diagonal)
    # the root, the product and the end are rounded themselves
    wanted += 8 * 2.0**-53 * (np.abs(state) + wanted)
    for half in (high - state, state - low):
        assert (half >= wanted).all()
        assert half == pytest.approx(wanted, rel=1e-6, abs=1e-9)
