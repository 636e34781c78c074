"""A run names all that left a declared range or rate, and shows where the observer was void."""

import dataclasses

import casadi as ca
import numpy as np
import pytest

from obsynth.evaluate import plot_alarms, plot_run, plot_signal, report, simulate
from obsynth.symbolic import Plant, Scenario

pytestmark = [pytest.mark.usefixtures("no_window"), pytest.mark.filterwarnings("error")]

GIVEN = ("inputs", "unknown_inputs", "faults", "disturbances", "scheduling")
STEPS = 12


def row():
    """a follows v, b sums d and f up; the sensor of a has a range of its own."""
    plant = Plant("row")
    a, b = plant.states("a b", range=[(-1, 1), (-2, 2)])
    (v,) = plant.inputs("v", range=(-1, 1))
    (d,) = plant.unknown_inputs("d", range=(-1, 1))
    (f,) = plant.faults("f", range=(-1, 1), rate=0.5)
    (w,) = plant.disturbances("w", bound=0.5)
    (rho,) = plant.scheduling("rho", range=(0, 1))
    plant.dynamics([v, d + f + rho * 0], Ts=1.0)
    plant.outputs([a + w, b + rho * 0], names=["shaft", "arm"], range=[(-1.25, 1.25), None])
    return plant


class Blind:
    """Bounds nothing and says status 0."""

    method, fault_delay, half_widths, ode, step_covered = "blind", 0, None, None, False

    def __init__(self, plant):
        self.model = plant
        memory, u, y, theta = (
            ca.SX.sym(name, n) for name, n in zip("muyt", (1, 1, 2, 1), strict=True)
        )
        wide = [ca.SX.ones(n) * sign * ca.inf for n in (2, 1) for sign in (-1, 1)]
        names = ["xhat", "fhat", "x_lower", "x_upper", "f_lower", "f_upper", "status"]
        results = [memory, ca.SX.zeros(2), ca.SX.zeros(1), *wide, ca.SX(0)]
        ports = ["memory", "u", "y", "theta"]
        self.step = ca.Function("step", [memory, u, y, theta], results, ports, ["next", *names])

    def memory0(self, guess, x_range=None, f_range=None, y0=None):
        return np.zeros(1)


def said(**changes):
    """What a run says is outside, with a few samples changed."""
    given = {name: np.zeros((STEPS + 1, 1)) for name in GIVEN}
    for name, values in changes.items():
        for k, value in values.items():
            given[name][k] = value
    plant = row()
    run = simulate(plant, Blind(plant), Scenario("row", STEPS, x0=[0, 0], guess=[0, 0], **given))
    page = run._repr_html_().replace("&#x27;", "'")
    assert all(run.summary().note.count(line) == page.count(line) == 1 for line in run.outside)
    return run.outside


def test_what_stays_on_its_border_is_inside():
    """Mutant: `beyond < 0` for what is inside."""
    assert said(inputs={3: 1}, faults={5: 0.5}, disturbances={2: -0.5}, scheduling={1: 1}) == ()


def test_every_excursion_is_named():
    """When it was first, how often, how far, by the signal's name; once in page and summary.

    Mutants: the smallest excess for the largest, states or sensors left out, the first jump only.
    """
    ends = "at 2 instants, first k ="
    assert said(inputs={4: 1.5, 6: -1.75, 7: 0.5}) == (
        f"a is outside its range [-1, 1] {ends} 5: 1.5; at most 0.75 beyond",
        f"v is outside its range [-1, 1] {ends} 4: 1.5; at most 0.75 beyond",
        f"shaft is outside its sensor's range [-1.25, 1.25] {ends} 5: 1.5; at most 0.5 beyond",
    )
    assert said(unknown_inputs={4: 2.0, 6: -2.5}) == (
        "b is outside its range [-2, 2] at 1 instants, first k = 7: -2.5; at most 0.5 beyond",
        f"d is outside its range [-1, 1] {ends} 4: 2; at most 1.5 beyond",
    )
    once = "at 1 instants, first k = 9:"
    assert said(disturbances={9: 0.6}) == (
        f"w is outside its range [-0.5, 0.5] {once} 0.6; at most 0.1 beyond",
    )
    assert said(scheduling={9: -0.5}) == (
        f"rho is outside its range [0, 1] {once} -0.5; at most 0.5 beyond",
    )
    assert said(faults={9: 1.5, 10: 1.0, 11: 0.5}) == (
        f"f is outside its range [-1, 1] {once} 1.5; at most 0.5 beyond",
        "f moves by 1.5 from k = 8 to 9; its declared rate is 0.5 per step, exceeded 1 times, by "
        "at most 1",
    )
    assert said(faults={3: 0.75, 4: -0.25})[0].endswith("exceeded 2 times, by at most 0.5")


# -- void and recovering -----------------------------------------------------------------------


def voided(run, *bits):
    """A run whose step was void or recovering: (bit, first, last) each."""
    status = run.status & 1
    for bit, first, last in bits:
        status[first : last + 1] |= bit
    return dataclasses.replace(run, status=status)


def test_stretches_of_void_and_recovering_are_named(toy_run, toy, tmp_path):
    """Mutants: `until` the last void, a stretch that ends with its void, 64 alone taken for one."""
    run = voided(toy_run, (8, 30, 32), (64, 33, 42), (8, 40, 40), (64, 90, 99), (8, 150, 150))
    words = [
        "void at 4 instants, k = 30 to 40, recovering until k = 42",
        "void at 1 instant, k = 150",
    ]
    assert [str(v) for v in run.domain.voids] == words
    page = report(tmp_path / "page.html", toy.observer(toy.plant), run).read_text()
    for text in (str(run.domain), run._repr_html_(), run.summary().note, page):
        assert all(line in text for line in words)
    assert "truth, estimate, interval and void instants" in page
    many = voided(toy_run, *((8, k, k) for k in range(10, 40, 2)))
    assert "10 more such stretches" in str(many.domain)
    assert toy_run.domain.voids == () and "void" not in toy_run._repr_html_()


def shaded(ax, word):
    """Start and end of every bar of a kind."""
    found = [c for c in ax.collections if c.get_label() == word]
    boxes = [path.get_extents() for c in found for path in c.get_paths()]
    return [(float(box.x0), float(box.x1)) for box in boxes]


@pytest.mark.parametrize("late", [0, 1])
def test_void_and_recovering_stretches_are_shaded(toy, late):
    """With their own names in the legend; a fault's interval came with the status one later.

    Mutants: `status` of faults not moved by the delay, void instants shaded as recovering too.
    """
    run = simulate(toy.plant, toy.observer(toy.plant, fault_delay=late), toy.scenario(), seed=1)
    run = voided(run, (8, 100, 103), (64, 104, 113), (8, 108, 108))
    axes = plot_run(run)
    for ax, back in zip(axes, (0, 0, late), strict=True):
        t = run.t - 0.5 * back
        assert shaded(ax, "void") == [(t[100], t[104]), (t[108], t[109])]
        assert shaded(ax, "recovering") == [(t[104], t[108]), (t[109], t[114])]
    words = [text.get_text() for text in axes[0].figure.legends[0].get_texts()]
    assert words == ["truth", "estimate", "interval", "void", "recovering"]
    assert shaded(plot_signal(run, "a")[0], "void") == [
        (run.t[100], run.t[104]),
        (run.t[108], run.t[109]),
    ]
    rows = plot_alarms(run, np.zeros(run.f.shape))
    assert shaded(rows, "void") == [(run.t[100], run.t[104]), (run.t[108], run.t[109])]
    assert len(shaded(rows, "recovering")) == 2
    calm = plot_run(voided(run))
    assert shaded(calm[0], "void") == shaded(calm[0], "recovering") == []


def test_the_sets_of_a_void_do_not_set_the_scale(toy_run):
    """Mutant: `_limits` of all settled instants."""
    upper = toy_run.x_upper.copy()
    upper[100, 0] = 1e6
    run = dataclasses.replace(voided(toy_run, (8, 100, 100)), x_upper=upper)
    assert plot_run(run)[0].get_ylim()[1] < 100
