"""Bounds still enclose when the step is evaluated in single precision."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from obsynth.derive.rigour import outward
from obsynth.designs.filter_bank.method import FilterBank
from obsynth.designs.set_adaptive.method import SetAdaptiveObserver

BOUND = 4.5e-3
A13, A20, S_C, K = 1.329e-4, 1.772e-4, 0.0154, 1.329e-3
LEVELS = np.array([(0.44, 0.56), (0.04, 0.16), (0.24, 0.36)])
REGION = [(0.2, 0.9), (0.0, 0.4), (0.1, 0.6)]

UNARY = {
    ca.OP_NEG: np.negative,
    ca.OP_FABS: np.abs,
    ca.OP_SQRT: np.sqrt,
    ca.OP_SQ: np.square,
    ca.OP_SIGN: np.sign,
    ca.OP_NOT: np.logical_not,
    ca.OP_ASSIGN: np.positive,
    ca.OP_TWICE: lambda a: a + a,
    ca.OP_INV: np.reciprocal,
}
BINARY = {
    ca.OP_ADD: np.add,
    ca.OP_SUB: np.subtract,
    ca.OP_MUL: np.multiply,
    ca.OP_DIV: np.divide,
    ca.OP_FMIN: np.fmin,
    ca.OP_FMAX: np.fmax,
    ca.OP_LT: np.less,
    ca.OP_LE: np.less_equal,
    ca.OP_AND: np.logical_and,
    ca.OP_OR: np.logical_or,
    # a branch that is not taken counts as zero, whatever is in it
    ca.OP_IF_ELSE_ZERO: lambda c, a: np.where(c != 0, a, 0),
}


def in_numpy(function, kind):
    """The instructions of a function in one NumPy precision, one column for each run."""
    program = [
        (
            function.instruction_id(i),
            function.instruction_input(i),
            function.instruction_output(i),
            function.instruction_constant(i) if function.instruction_id(i) == ca.OP_CONST else None,
        )
        for i in range(function.n_instructions())
    ]

    def call(*arguments):
        inputs = [np.asarray(a).astype(kind) for a in arguments]
        many = inputs[0].shape[1]
        outputs = [np.zeros((function.size1_out(i), many), kind) for i in range(function.n_out())]
        work = {}
        with np.errstate(all="ignore"):
            for code, source, target, constant in program:
                if code == ca.OP_CONST:
                    work[target[0]] = kind(constant)
                elif code == ca.OP_INPUT:
                    work[target[0]] = inputs[source[0]][source[1]]
                elif code == ca.OP_OUTPUT:
                    outputs[target[0]][target[1]] = work[source[0]]
                elif code in UNARY:
                    work[target[0]] = np.asarray(UNARY[code](work[source[0]])).astype(kind)
                else:
                    value = BINARY[code](work[source[0]], work[source[1]])
                    work[target[0]] = np.asarray(value).astype(kind)
        return outputs

    return call


def root(z):
    return np.sign(z) * np.sqrt(np.abs(z))


def rates(x, u, theta):
    one, two = A13 * root(x[0] - x[2]), A13 * root(x[2] - x[1])
    return (
        np.array([u[0] + theta[0] - one, u[1] + theta[1] + two - A20 * root(x[1]), one - two]) / S_C
    )


def move(x, u, theta, h):
    k1 = rates(x, u, theta)
    k2 = rates(x + h / 2 * k1, u, theta)
    k3 = rates(x + h / 2 * k2, u, theta)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rates(x + h * k3, u, theta))


def outside(observer, lanes, steps, kind=np.float32, seed=0):
    """How many samples have a state or a constant fault outside of its set."""
    rng = np.random.default_rng(seed)
    step, h = in_numpy(observer.step, kind), float(observer.model.Ts)
    theta = 6e-5 * rng.choice([-1.0, 0.0, 1.0], (2, lanes))
    inner = LEVELS.mean(axis=1) + 0.4 * np.diff(LEVELS)[:, 0] * np.array([1, 1, 1]) * (
        rng.choice([-0.5, 0.5], (lanes, 3))
    )
    x = inner.T
    memory = np.tile(observer.memory0(inner[0], x_range=LEVELS)[:, None], lanes)
    count, valid = 0, np.ones(lanes, dtype=bool)
    for k in range(steps):
        valid &= ((x >= LEVELS[:, :1]) & (x <= LEVELS[:, 1:])).all(axis=0)
        w = BOUND * (1 - 1e-12) * rng.choice([-1.0, 1.0], (2, lanes))
        y = x[:2] + w
        u = np.array(
            [
                np.maximum(0, -K * root(y[0] - 0.5)),
                np.maximum(0, -K * root(y[1] - 0.1) + A20 * root(y[1])),
            ]
        )
        u = u.astype(kind).astype(float)
        memory, _, _, low, high, f_low, f_high, status = step(memory, u, y)
        wrong = (low.astype(float) > x).any(axis=0) | (high.astype(float) < x).any(axis=0)
        wrong |= (f_low.astype(float) > theta).any(axis=0)
        wrong |= (f_high.astype(float) < theta).any(axis=0)
        wrong |= status[0] != 0
        count += int((wrong & valid).sum())
        x = move(x, u, theta, h)
        # runs that leave the ranges start again, as a new plant
        gone = ~valid
        if gone.any():
            x[:, gone] = inner.T[:, gone]
            memory[:, gone] = observer.memory0(inner[0], x_range=LEVELS)[:, None]
            valid[:] = True
        assert k == 0 or np.isfinite(memory).all()
    return count


@pytest.fixture(scope="module", params=["adaptive", "bank"])
def method(request):
    if request.param == "bank":
        return FilterBank(Ts=0.01, region=REGION)
    return SetAdaptiveObserver(gain_cap=0.5, Ts=0.05)


def test_single_precision_encloses(tanks, method):
    observer = replace(method, precision="single").design(tanks)
    assert "single" in str(observer.guarantee)
    assert outside(observer, 200, 100) == 0


def test_a_step_for_double_does_not_enclose_in_single(tanks, method):
    observer = method.design(tanks)
    assert outside(observer, 50, 20) > 0
    assert outside(observer, 50, 20, kind=np.float64) == 0


def test_the_numpy_step_is_the_step(tanks, method):
    observer = method.design(tanks)
    rng = np.random.default_rng(3)
    memory = observer.memory0([0.5, 0.1, 0.3])
    u, y = rng.uniform(0, 1e-4, 2), [0.5, 0.1]
    for _ in range(5):
        expected = observer.step(memory, u, y)
        found = in_numpy(observer.step, np.float64)(memory[:, None], u[:, None], [[0.5], [0.1]])
        for a, b in zip(expected, found, strict=True):
            np.testing.assert_array_equal(np.array(a), b)
        memory = np.array(expected[0]).ravel()


@pytest.mark.long
def test_a_million_steps_in_single_precision(tanks, method):
    observer = replace(method, precision="single").design(tanks)
    assert outside(observer, 2000, 500) == 0


def test_outward_boxes():
    box = np.array([(0.24, 0.36), (0.25, 0.5), (-0.1, 0.1)])
    wide = outward(box, "single")
    assert (wide == wide.astype(np.float32)).all()
    assert (wide[:, 0] <= box[:, 0]).all()
    assert (wide[:, 1] >= box[:, 1]).all()
    assert np.abs(wide - box).max() < 1e-7
    assert wide[1].tolist() == [0.25, 0.5]
