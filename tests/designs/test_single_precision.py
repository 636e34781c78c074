"""Every method in single precision: its step in NumPy's float32 beside plants in doubles."""

from functools import cache

import casadi as ca
import numpy as np
import pytest
import sympy as sp
from singles import constants, follow, mean_widths, numpy_step, outside, truth

import obsynth as ob
from methods import METHODS, SINGLE, observer_of, two_tanks
from obsynth.derive.intervals.program import Program
from obsynth.derive.rigour import inward
from obsynth.designs.core.boxes import LIMITS, Ends, Lifted, Rounding, cut_box
from obsynth.designs.core.contractor import Contractor
from obsynth.designs.core.core import Seen
from obsynth.designs.core.half_widths import HalfWidths, Running, all_around
from obsynth.designs.core.lifted import lift
from obsynth.designs.core.rounding import rounding_bound
from obsynth.designs.core.stepping import clip, inside
from obsynth.designs.general.method import GeneralUIO
from obsynth.designs.general.rounding import settle, shown
from obsynth.designs.general.step import build_core, memory_sizes, stages
from obsynth.designs.set_membership.synthesis import frame
from obsynth.designs.set_membership.zonotope import (
    Frame,
    Real,
    Strips,
    Zonotope,
    corrected,
    moved,
    reduced,
)

LANES, STEPS = 12, 40
# What single precision may add to the mean half widths, relative to those in doubles.
WIDER = {
    "bounded_error_uio": 0.03,
    "general_uio": 0.005,
    "general_uio.ellipsoid": 0.005,
    "general_uio.l2": 0.005,
    "interval_observer": 0.005,
    "luenberger": 0.005,
    "hinf_uio": 0.005,
    "set_membership": 0.12,
}
SLOW = {*WIDER} - {"luenberger"}
NAMES = [pytest.param(name, marks=[pytest.mark.long] * (name in SLOW)) for name in WIDER]


def single_of(name):
    return observer_of(name + SINGLE)


@cache
def runs_of(name):
    scenario = METHODS[name].scenario()
    return truth(observer_of(name).model, scenario, LANES, 1, min(scenario.steps, STEPS))


@pytest.mark.parametrize("name", NAMES)
def test_no_truth_is_outside_of_a_set_in_single_precision(name):
    """Nor is any call void, and sets are about as narrow as in doubles.

    Mutants: the precision not passed to `rounding_bound` (bounded error, general, Luenberger);
    `above` of doubles; no slack for the reading in `Contractor._told`; ends of constants that are
    rounded to the nearest number.
    """
    observer, runs, scenario = single_of(name), runs_of(name), METHODS[name].scenario()
    assert observer.precision == "single" and observer.certificate.valid
    said = follow(observer, scenario, runs, "single")
    assert outside(observer, runs, said) == (0, 0.0)
    wanted = mean_widths(follow(observer_of(name), scenario, runs, "double"))
    found = mean_widths(said)
    noise = wanted > 1e-6  # of what is measured exactly nothing is left but rounding
    assert np.all(found[noise] <= (1.0 + WIDER[name]) * wanted[noise])
    assert observer.half_widths is not None
    assert np.all(observer.half_widths >= (1.0 - 1e-9) * observer_of(name).half_widths)


@pytest.mark.parametrize("name", [*NAMES, pytest.param("qpv_observer", marks=pytest.mark.long)])
def test_no_number_of_a_step_is_beyond_single_precision(name):
    """Mutants: `Ends.of` without the precision; `FAR` for the end of a fault."""
    limits = LIMITS["single"]
    for value in constants(single_of(name).step):
        size = abs(value)
        known = (np.inf, limits.largest, float(np.finfo(np.float32).max))
        assert size <= limits.far or size in known, value


def test_the_allowances_are_those_of_the_precision():
    """Of the general class: at least the errors seen, and not those of doubles.

    Mutants: `rounding_bound` of doubles; the reading taken for a number of single precision.
    """
    design = GeneralUIO().design(two_tanks()).certificate.design
    single = settle(design.changed(options={**design.options, "precision": "single"}))
    _, second, _ = stages(single)
    rng, count = np.random.default_rng(3), 4000
    limits = single.limits
    most = shown(single)
    x = rng.uniform(*limits.x.T[:, :, None], (len(limits.x), count)).astype(np.float32)
    u = rng.uniform(*limits.u.T[:, :, None], (len(limits.u), count)).astype(np.float32)
    y = rng.uniform(-1.0, 1.0, (len(most), count)) * most[:, None]
    given = [part.astype(float) for part in (x, u)]
    exact = np.array(second.map(count)(*given, y)[0])
    found = numpy_step(second, "single")(*given, y)[0]
    seen = np.abs(found - exact).max(axis=1)
    assert np.all(seen <= single.rounding.c) and np.all(seen > 1e3 * design.rounding.c)
    # of a number that comes to nothing but itself, the reading's own rounding is all there is
    one = ca.SX.sym("y")
    same = ca.Function("same", [one], [one - 1.0], ["y"], ["e"])
    box = {"y": (np.array([[1.0]]), np.array([[1.1]]))}
    read = rounding_bound(same, box, "single", read=("y",))["e"].error[0]
    assert 1.0 <= read / 2.0**-24 < 1.01
    assert rounding_bound(same, box, "single")["e"].error[0] == 0.0


def test_a_reading_is_rounded_before_it_is_used():
    """A strip holds the state whose reading single precision rounds. Mutant: no slack for it."""
    plant = ob.Plant("one")
    (x,) = plant.states("x", range=(0, 1))
    (w,) = plant.disturbances("w", bound=1000)
    plant.dynamics([x], Ts=1)
    plant.outputs([x + w])
    contractor = Contractor(plant, 1.0, precision="single")
    reading, wide = ca.SX.sym("y"), ca.SX.sym("ends", 2)
    cut = contractor.measure(Ends(wide[0], wide[1]), reading, [ca.SX(1)])
    function = numpy_step(ca.Function("cut", [wide, reading], [cut.lower, cut.upper]), "single")
    held = np.random.default_rng(5).uniform(0.0, 1.0, 2000)
    for side in (-1.0, 1.0):
        # a little less noise than allowed, so that doubles do not round beyond it
        y = (held + side * (1000.0 - 1e-9))[None]
        lower, upper = function(np.array([0 * held - 1e4, 0 * held + 1e4]), y)
        assert (lower[0] <= held).all() and (held <= upper[0]).all()
        assert (upper - lower).max() < 2000.0 + 0.01


@pytest.mark.parametrize("root", [False, True])
def test_half_widths_of_code_are_not_below_those_of_numbers(root):
    """Nor what they move to; `settle` is above both. Mutant: `above` of doubles."""
    rng, k = np.random.default_rng(7), 6
    decay, reach = rng.uniform(0.0, 0.15, (k, k)), rng.uniform(0.1, 3.0, (k, k))
    offset, add = rng.uniform(0.1, 1.0, k), rng.uniform(0.0, 1.0, k)
    bound = Running(decay, offset, reach, add, root, "single")
    s = ca.SX.sym("s", k)
    function = ca.Function("all", [s], [*all_around([bound], s, ca.SX.zeros(k))])
    given = rng.uniform(0.1, 9.0, (k, 2000)).astype(np.float32).astype(float)
    half, moved = numpy_step(function, "single")(given)
    inner = np.sqrt(reach @ given) if root else reach @ given
    assert (half >= inner + add[:, None]).all()
    assert (moved >= decay @ given + offset[:, None]).all()
    for j in range(3):
        assert (half[:, j] <= bound.half_widths(given[:, j])).all()
        assert (moved[:, j] <= bound.next(given[:, j])).all()
    assert (half <= (inner + add[:, None]) * (1.0 + 2.0**-16)).all()


@pytest.mark.parametrize("number", [0.1, -0.3, 1.7])
def test_numbers_that_are_added_are_rounded_outwards(number):
    """x + c beside -c: nothing but the rounding of c is left. Mutant: c rounded to nearest."""
    x = ca.SX.sym("x")
    program = Program.from_casadi(ca.Function("sum", [x], [x + number]))
    ends = Lifted.point(x, -2.0, 2.0)
    (found,) = lift(program, program.outputs, [ends], Rounding("single"))
    function = numpy_step(ca.Function("ends", [x], [found.lower, found.upper]), "single")
    near = np.float32(-number) + np.arange(-3, 4, dtype=np.float32) * np.float32(2.0**-26)
    lower, upper = function(near[None].astype(float))
    exact = near.astype(float) + number
    assert (lower[0] <= exact).all() and (exact <= upper[0]).all()


def test_comparisons_are_with_numbers_inside():
    """And so are estimates clipped. Mutant: limits rounded to the nearest number, or outwards."""
    box = np.array([[0.1, 0.3], [-0.7, -0.1], [1.0, np.inf]])
    inner = inward(box, "single")
    assert (inner == inner.astype(np.float32)).all()
    assert (inner[:, 0] >= box[:, 0]).all() and (inner[:, 1] <= box[:, 1]).all()
    assert np.abs(inner[:2] - box[:2]).max() < 2.0**-23
    assert np.array_equal(inward(box, "double"), box)
    v = ca.SX.sym("v", 3)
    tests = ca.Function("t", [v], [clip(v, box, "single"), inside(v, v, box, "single")])
    beyond = np.array([[0.31], [-0.71], [7.0]])
    clipped, held = numpy_step(tests, "single")(beyond)
    assert clipped[0, 0] <= 0.3 and clipped[1, 0] >= -0.7 and not held[0, 0]


def test_half_widths_count_what_rounding_adds_to_a_reading():
    """Of exact readings nothing but rounding is left. Mutant: rounding left out."""
    plant = ob.Plant("one")
    (x,) = plant.states("x", range=(0, 1000))
    plant.dynamics([x], Ts=1)
    plant.outputs([x])
    contractor = Contractor(plant, 1.0, precision="single")
    found = HalfWidths(contractor, 0).lost[1][0]
    reading, wide = ca.SX.sym("y"), ca.SX.sym("ends", 2)
    cut = contractor.measure(Ends(wide[0], wide[1]), reading, [ca.SX(1)])
    function = numpy_step(ca.Function("cut", [wide, reading], [cut.lower, cut.upper]), "single")
    y = np.random.default_rng(5).uniform(900.0, 1000.0, (1, 500))
    lower, upper = function(np.vstack([0.0 * y, 0.0 * y + 1000.0]), y)
    assert 0.5 * (upper - lower).max() <= found < 1e-5 * 1000.0


def test_what_single_precision_has_no_room_for_is_refused_by_name():
    """Mutants: no limit of ranges; none of counted calls; limits of inputs that are not widened."""
    with pytest.raises(ob.ObsynthError, match=r"horizon is 5000000.*4194304.*precision='double'"):
        ob.IntervalObserver(precision="single", horizon=5_000_000)

    def level(top, noise):
        plant = ob.Plant("tank")
        (h,) = plant.states("h", range=(0, top))
        (u,) = plant.inputs("u", range=(0, 0.1))
        (w,) = plant.disturbances("w", bound=noise)
        plant.dynamics([h / 2 + u + w], Ts=1)
        plant.outputs([h + 3 * w])
        return plant

    method = GeneralUIO(precision="single")
    with pytest.raises(ob.ObsynthError, match=r"h is declared up to 1e\+11.*precision='double'"):
        method.design(level(1e11, 0.1))
    observer = method.design(level(10.0, 0.1))
    # a limit that single precision does not hold is one that it does, so that it may be reached
    (upper,) = observer.model.box("u")[:, 1]
    assert float(np.float32(0.1)) == upper > 0.1
    assert any("rounded to IEEE single" in claim for claim in observer.guarantee.claims)
    assert "true ones that are rounded" in str(observer.guarantee)


def test_a_design_of_which_rounding_leaves_nothing_is_refused_with_both_half_widths():
    """A level that moves by 1 about 10^6. Mutant: no comparison with doubles."""

    def level(low):
        plant = ob.Plant("tank")
        (h,) = plant.states("h", range=(low, low + 1))
        (w,) = plant.disturbances("w", bound=0.01)
        plant.dynamics([h / 2 + sp.Integer(low) / 2 + sp.Rational(1, 4) + w], Ts=1)
        plant.outputs([h + 3 * w])
        return plant

    told = r"nothing to say of h: take precision='double'\n  h: \+-4.* \+-0.016 in doubles"
    with pytest.raises(ob.InfeasibleDesign, match=told):
        GeneralUIO(precision="single").design(level(10**6))
    wide = GeneralUIO(precision="single").design(level(1000)).half_widths
    assert 0.015 < wide[0] < 0.02


def test_sets_of_zonotopes_hold_the_real_ones_in_single_precision():
    """Strips, corrections, images, hulls and reductions. Mutants: steps or factors of doubles."""
    rng, N, m, M, count = np.random.default_rng(11), 3, 2, 30, 300
    real = Real("single", M + N + m)
    shapes = [(N, 1), (N, M), (N, 1), (m, N), (m, 1), (m, 1), (N, m), (N, N), (N, 1)]
    c, G, s, H, rest, sigma, L, J, offset = symbols = [ca.SX.sym("s", *shape) for shape in shapes]
    z, used = Zonotope(c, G, s, real), ca.SX.ones(m)
    strips = Strips.read(z, H, rest, sigma, used)
    after, image = corrected(z, L, strips, used), moved(z, J, offset, [], s)
    V = np.linalg.qr(rng.normal(size=(N, N)))[0] @ np.diag([1.0, 3.0, 0.2])
    held = frame(V)
    small = reduced(z, M // 2, Frame(held.V, held.W, held.size, held.leak, real))
    outputs = [strips.innovation, strips.seen, strips.sigma, z.hull.lower, z.hull.upper]
    for found in (after, image, small):
        outputs += [found.centre, found.generators, found.slack]
    function = ca.Function("z", symbols, [ca.vec(ca.densify(part)) for part in outputs])
    given = [rng.uniform(-1.0, 1.0, (a * b, count)).astype(np.float32) for a, b in shapes]
    for k, size in ((0, 3.0), (1, 0.2), (2, 1e-6), (5, 0.1)):
        given[k] = np.float32(size) * (np.abs(given[k]) if k in (2, 5) else given[k])
    given = [part.astype(float) for part in given]
    told = numpy_step(function, "single")(*given)
    directions = rng.normal(size=(N, 20))
    for k in range(count):
        c, G, s, H, rest, sigma, L, J, offset = (
            part[:, k].reshape(shape, order="F") for part, shape in zip(given, shapes, strict=True)
        )
        found = [
            part[:, k].reshape(out.shape, order="F")
            for part, out in zip(told, outputs, strict=True)
        ]
        b, seen, wide, low, high = found[:5]
        lost = np.abs(rest - H @ c - b) + total(H @ G - seen) + np.abs(H) @ s + sigma
        assert (lost <= wide).all()
        reach = total(G) + s
        assert (low <= c - reach).all() and (c + reach <= high).all()
        centre, columns, slack = found[5:8]
        lost = np.abs(c + L @ b - centre) + total(G - L @ seen - columns[:, m:]) + s
        assert (lost + total(L @ np.diag(wide[:, 0]) - columns[:, :m]) <= slack).all()
        centre, columns, slack = found[8:11]
        lost = np.abs(J @ c + offset - centre) + total(J @ G - columns[:, N:]) + np.abs(J) @ s + s
        assert (lost <= np.diag(columns[:, :N])[:, None]).all() and not slack.any()
        # supports of the set and of what is put in its place
        _, columns, slack = found[11:]
        d = directions.T
        assert (total(d @ G) + np.abs(d) @ s <= total(d @ columns) + np.abs(d) @ slack).all()


def total(matrix):
    return np.abs(matrix).sum(axis=1, keepdims=True)


@pytest.mark.long
def test_rounding_of_the_four_tanks_with_peak_bounds_is_bounded_closely():
    """The whole core in one function, readings within 1 of the estimate, faults within 5.

    10^5 samples: at most 2 times what is seen for estimates, 3.5 for ends of states, 5 of faults.
    """
    plant = ob.plants.quadruple_tank().discretise("euler", Ts=1.0)
    design = ob.BoundedErrorUIO(bounds="peak", precision="single").design(plant).certificate.design
    parts = {name: ca.SX.sym(name, size) for name, size in memory_sizes(design).items()}
    u, y = ca.SX.sym("u", 2), ca.SX.sym("y", 3)
    known = build_core(design).run(Seen(parts, u, ca.SX(0, 1), y, [ca.SX(1)] * 3))
    first, second, _ = stages(design)
    innovation = second(first(parts["prediction"], u, y), u, y)[1]
    ends = {"x_lower": known.x.lower, "x_upper": known.x.upper}
    ends |= {"f_lower": known.f.lower, "f_upper": known.f.upper}
    outputs = {"xhat": known.xhat, "fhat": known.fhat, **ends, "innovation": innovation}
    together = ca.cse(ca.vertcat(*(ca.densify(value) for value in outputs.values())))
    cuts = np.cumsum([0, *(value.numel() for value in outputs.values())]).tolist()
    split = ca.vertsplit(together, cuts)
    core = ca.Function("core", [*parts.values(), u, y], split, [*parts, "u", "y"], [*outputs])
    lo, hi = cut_box(plant.box("x"), 4**4)
    f, s = np.full((2, lo.shape[1]), 5.0), np.full((parts["bound"].numel(), 1), 1e-3)
    v, nu = plant.box("u"), np.array([[1.0], [1.0], [10.0]])
    box = {
        "prediction": (np.vstack([lo, -f]), np.vstack([hi, f])),
        "bound": (0.0 * s, s),
        "u": (v[:, :1], v[:, 1:]),
        "y": (lo[:3] - 1.0, hi[:3] + 1.0),
    }
    found = rounding_bound(core, box, "single", {"innovation": (-nu, nu)})
    rng, count = np.random.default_rng(0), 100_000
    low, high = plant.box("x").T[:, :, None]
    x = rng.uniform(low, high, (4, count))
    x = np.where(
        rng.random(x.shape) < 0.15, rng.choice([0.0, 1.0], x.shape) * (high - low) + low, x
    )
    points = [np.vstack([x, rng.uniform(-5, 5, (2, count))]), s * rng.random((len(s), count))]
    points += [rng.uniform(v[:, :1], v[:, 1:], (2, count)), x[:3] + rng.uniform(-1, 1, (3, count))]
    points = [part.astype(np.float32).astype(float) for part in points]
    single, exact = (numpy_step(core, kind)(*points) for kind in ("single", "double"))
    limits = {"xhat": 2.0, "fhat": 2.0, "x_lower": 3.5, "x_upper": 3.5, "f_lower": 5, "f_upper": 5}
    for name, a, b in zip(outputs, single, exact, strict=True):
        seen, bound = np.abs(a - b).max(axis=1), found[name].error
        assert np.all(seen <= bound), name
        if name == "xhat":  # h3 is its reading: nothing is rounded that is seen
            seen[2] = np.inf
        assert name == "innovation" or np.all(bound <= limits[name] * seen), name
