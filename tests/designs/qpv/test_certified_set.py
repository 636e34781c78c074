"""What the certificate says of the error, held against many trajectories.

The truth moves on any path in the region X: B is invertible, so an input exists for each.
"""

from types import SimpleNamespace

import numpy as np
import pytest

CENTRE = np.array([10.0, 10.0, 10.0, 0.0, 0.0, 0.0])
Q = np.array([0.2, 0.2, 0.2, 0.1, 0.1, 0.1])
G, H = np.diag([0.25, 0.15, 0.25]), np.diag([0.025, 0.015, 0.025])


def A_of(theta):
    """A(theta) of the paper, typed a second time."""
    t1, t2 = theta.T
    one = np.ones_like(t1)
    rows = [
        [-4 - t1, 10 * one, 2 + 2 * t2],
        [-one, -1 - t2, 1.5 + 2 * t1],
        [one, one, -4 - 3 * t1],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=1)


def gain_of(observer, theta):
    t1, t2 = theta.T
    weights = np.stack([(1 - t1) * (1 - t2), (1 - t1) * t2, t1 * (1 - t2), t1 * t2], axis=-1)
    L = np.stack([observer.gains[f"L{k}"] for k in (1, 2, 3, 4)])
    return np.einsum("kl,lij->kij", weights, L)


def in_unit_ball(rng, count, n):
    directions = rng.standard_normal((count, n))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return directions * rng.uniform(0, 1, (count, 1)) ** (1 / n)


class Swarm:
    """Many plants with their observers: paths of state and scheduling, errors at time t."""

    def __init__(self, observer, count, seed):
        rng = np.random.default_rng(seed)
        self.observer, self.count = observer, count
        # x(t) - c turns in a plane inside the ellipsoid, f stands still
        self.f = np.sqrt(Q[3:]) * in_unit_ball(rng, count, 3)
        self.f[: count // 8] = 0.0
        room = np.sqrt(1.0 - (self.f**2 / Q[3:]).sum(axis=1))
        frame = np.linalg.qr(rng.standard_normal((count, 3, 2)))[0]
        self.frame = (
            frame * np.sqrt(Q[:3])[:, None] * (room * rng.uniform(0, 1, count))[:, None, None]
        )
        self.turning = rng.uniform(0, 12, count)
        self.speed = rng.uniform(0, 9, (count, 2))
        self.phase = rng.uniform(0, 2 * np.pi, (count, 3))
        P = observer.gains["P"]
        root = np.linalg.inv(np.linalg.cholesky(P)).T
        e = in_unit_ball(rng, count, 6)
        e[: count // 2] /= np.linalg.norm(e[: count // 2], axis=1, keepdims=True)
        self.e = e @ root.T

    def path(self, t):
        angle = self.turning * t + self.phase[:, 2]
        turned = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        return CENTRE[:3] + np.einsum("kij,kj->ki", self.frame, turned)

    def theta(self, t):
        return 0.5 + 0.5 * np.sin(self.speed * t + self.phase[:, :2])

    def rate(self, e, t, w=None):
        """x' - xhat' from the plant's equations and the observer's, not from the error's."""
        theta, x = self.theta(t), self.path(t)
        A, L = A_of(theta), gain_of(self.observer, theta)
        xhat, fhat = x - e[:, :3], self.f - e[:, 3:]
        moving = np.einsum("kij,kj->ki", A, x - xhat) + self.f * x - fhat * xhat
        innovation = e[:, :3].copy()
        if w is not None:
            moving = moving + w @ G
            innovation = innovation + w @ H
        d = -np.einsum("kij,kj->ki", L, innovation)
        d[:, :3] += moving
        return d

    def levels(self, P=None):
        P = self.observer.gains["P"] if P is None else P
        return np.einsum("ki,ij,kj->k", self.e, P, self.e)

    def step(self, t, h, w=None):
        e = self.e
        k1 = self.rate(e, t, w)
        k2 = self.rate(e + h / 2 * k1, t + h / 2, w)
        k3 = self.rate(e + h / 2 * k2, t + h / 2, w)
        k4 = self.rate(e + h * k3, t + h, w)
        self.e = e + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def violations(observer, alpha, count=10_000, duration=2.0, h=0.01, P=None):
    """Largest V(t + h) / (e^(-alpha h) V(t)) and largest V / V(0)."""
    swarm = Swarm(observer, count, seed=3)
    ratio, largest = 0.0, 0.0
    before = first = swarm.levels(P)
    for k in range(round(duration / h)):
        swarm.step(k * h, h)
        after = swarm.levels(P)
        living = before > 1e-12
        ratio = max(ratio, float((after[living] / before[living]).max() * np.exp(alpha * h)))
        largest = max(largest, float((after / first).max()))
        before = after
    return ratio, largest


@pytest.mark.long
@pytest.mark.parametrize("name", ["box_insc"])
def test_V_decays_at_every_step_from_ten_thousand_starts(name, designed):
    observer = designed(name)
    ratio, largest = violations(observer, observer.performance["decay"])
    assert ratio <= 1.0
    assert largest <= 1.0


def test_the_check_sees_a_faster_decay_and_another_P(designed):
    """Mutants: a decay that is not certified, and one row of the gains with the wrong sign."""
    observer = designed("box_insc")
    ratio, _ = violations(observer, 8.0, count=2000, duration=0.5)
    assert ratio > 1.0
    wrong = {
        name: np.array(gain) * [[1], [1], [1], [-1], [1], [1]]
        for name, gain in observer.gains.items()
        if name != "P"
    }
    mutant = SimpleNamespace(gains=wrong | {"P": observer.gains["P"]})
    ratio, largest = violations(mutant, 0.1, count=2000, duration=1.0)
    assert ratio > 1.0
    assert largest > 1.0


def noisy(observer, strength, count=4000, duration=2.0, h=1e-3, seed=5):
    """Largest V and largest errors under noise that pushes V up, or draws at random."""
    swarm = Swarm(observer, count, seed)
    P = observer.gains["P"]
    rng = np.random.default_rng(seed)
    B = np.zeros((count, 3))
    level, reach = 0.0, np.zeros(6)
    for k in range(round(duration / h)):
        if k % 5 == 0:
            L = gain_of(observer, swarm.theta(k * h))
            into = np.einsum(
                "ij,kjl->kil",
                P,
                np.concatenate([np.broadcast_to(G, (count, 3, 3)), np.zeros((count, 3, 3))], axis=1)
                - L @ H,
            )
            B = np.sign(np.einsum("kil,ki->kl", into, swarm.e)) * strength
            B[: count // 4] = rng.uniform(-strength, strength, (count // 4, 3))
        swarm.step(k * h, h, B)
        level = max(level, float(swarm.levels().max()))
        reach = np.maximum(reach, np.abs(swarm.e).max(axis=0))
    return level, reach


def test_bounded_noise_keeps_every_fault_inside_its_bound(designed):
    observer = designed("noise")
    level, reach = noisy(observer, 2.5, count=1500, duration=0.5)
    assert level <= 1.0
    widths = observer.performance["core_half_widths"]
    assert (reach <= widths).all()
    # the starts fill the set, so the bound is not idle
    assert reach[5] > 0.5 * widths[5]


def test_the_noise_check_sees_noise_that_is_too_large(designed):
    """Mutant: four hundred times the declared noise."""
    level, reach = noisy(designed("noise"), 1000.0, count=300, duration=0.2)
    assert level > 1.0
    assert (reach > designed("noise").performance["core_half_widths"]).any()
