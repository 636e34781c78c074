"""Planar robot arms with point masses at the ends of their links."""

from typing import Any

import sympy as sp
from sympy.simplify.fu import TR8

from obsynth.symbolic.errors import PlantError
from obsynth.symbolic.plant import Plant


def planar_arm_terms(q: Any, dq: Any, gravity: Any = 0) -> tuple[sp.Matrix, sp.Matrix, sp.Expr]:
    """Return mass matrix, bias vector and energy of an arm with unit masses and lengths.

    M(q) q'' + h(q, q') = tau. In the absolute angles a_i = q_1 + ... + q_i the kinetic energy
    has the coefficients mu_ij cos(a_i - a_j), mu_ij being the number of masses beyond both
    joints; the result is that form in the joint angles, so that every product of sines and
    cosines is a single sine or cosine.

    Parameters
    ----------
    q, dq : sequence of n sympy.Symbol
        Joint angles, from the downward vertical, and their rates.
    gravity : number or sympy.Expr
        0 for an arm that moves in a horizontal plane.

    Returns
    -------
    (sympy.Matrix, sympy.Matrix, sympy.Expr)
        M (n, n), h (n, 1) with Coriolis, centrifugal and gravity torques, and the energy.

    Examples
    --------
    >>> q, dq = sp.symbols("q1:3"), sp.symbols("dq1:3")
    >>> mass, bias, energy = planar_arm_terms(q, dq)
    >>> mass[0, 0], bias[1]
    (2*cos(q2) + 3, dq1**2*sin(q2))
    """
    n = len(q)
    gravity = sp.sympify(gravity)
    beyond = [n - i for i in range(n)]
    rates = [sum(dq[: i + 1]) for i in range(n)]
    mass, bias = sp.zeros(n, n), sp.zeros(n, 1)
    for i in range(n):
        for j in range(n):
            count = beyond[max(i, j)]
            angle = sum(q[j + 1 : i + 1]) if i >= j else -sum(q[i + 1 : j + 1])
            # a joint turns all links from its own on, hence sums over the absolute angles
            for k in range(i + 1):
                bias[k] += count * sp.sin(angle) * rates[j] ** 2
                for m in range(j + 1):
                    mass[k, m] += count * sp.cos(angle)
        for k in range(i + 1):
            bias[k] += gravity * beyond[i] * sp.sin(sum(q[: i + 1]))
    bias = bias.applyfunc(lambda e: _collected(e, dq))
    velocity = sp.Matrix(dq)
    potential = -gravity * sum(beyond[i] * sp.cos(sum(q[: i + 1])) for i in range(n))
    return mass, bias, (velocity.T * mass * velocity)[0] / 2 + potential


def _collected(expression: sp.Expr, dq: Any) -> sp.Expr:
    """Collect by sines, each with one quadratic form of the rates."""
    terms = sp.expand(expression)
    sines = sorted(terms.atoms(sp.sin), key=sp.default_sort_key)
    parts = sp.collect(terms, sines, evaluate=False)
    return sum((sp.factor(parts[s]) * s for s in sines if s in parts), sp.Integer(0))


def planar_arm(n: int, gravity: Any = 0) -> Plant:
    """Return the forward dynamics of a planar arm with two or three joints.

    Unit masses at the ends of links of unit length, no friction, driven by joint torques:
    q'' = M(q)^-1 (tau - h(q, q')).

    Parameters
    ----------
    n : int
        Number of joints, 2 or 3.
    gravity : number
        0 (horizontal plane) by default; 9.81 for an arm that hangs down.

    Returns
    -------
    Plant
        Continuous; angles q1..qn in rad, rates dq1..dqn in rad/s, torques tau1..taun in N m;
        the angles are measured. Any posture at rest is an equilibrium without gravity, the
        hanging one with it.

    Raises
    ------
    PlantError
        Another number of joints.

    References
    ----------
    Siciliano, Sciavicco, Villani, Oriolo: Robotics: Modelling, Planning and Control, Section
    7.3 (the two-link planar arm).

    Examples
    --------
    >>> arm = planar_arm(2)
    >>> arm.names("x"), arm.names("u")
    (('q1', 'q2', 'dq1', 'dq2'), ('tau1', 'tau2'))
    >>> sp.simplify(arm.rhs[2].subs({s.symbol: 0 for s in arm.x}))
    tau1 - 2*tau2
    """
    if n not in (2, 3):
        raise PlantError(f"a planar arm has 2 or 3 joints here, not {n!r}", n=n)
    plant = Plant(f"planar {n}R arm")
    q, dq, tau = _signals(plant, n)
    mass, bias, _ = planar_arm_terms(q, dq, gravity)
    inverse_times = mass.adjugate() * (sp.Matrix(tau) - bias)
    determinant = TR8(sp.expand(mass.det()))
    plant.dynamics([*dq, *(inverse_times / determinant)])
    plant.outputs(list(q), unit="rad")
    return plant


def planar_arm_bias(n: int = 3, gravity: Any = 0) -> Plant:
    """Return a plant whose right-hand side holds the bias vector h(q, q') of a planar arm.

    The arm with its mass matrix taken out: q' = dq, dq' = tau - h(q, dq). The Jacobian of its
    lower half is that of -h, a benchmark for range methods.

    Parameters
    ----------
    n : int
        Number of joints, 2 to 6.
    gravity : number
        As for `planar_arm`.

    Returns
    -------
    Plant
        With the signals and ranges of `planar_arm`.

    Raises
    ------
    PlantError
        Another number of joints.

    Examples
    --------
    >>> planar_arm_bias(2).rhs[3]
    -dq1**2*sin(q2) + tau2
    """
    if n not in range(2, 7):
        raise PlantError(f"the bias vector is there for 2 to 6 joints, not {n!r}", n=n)
    plant = Plant(f"bias vector of the planar {n}R arm")
    q, dq, tau = _signals(plant, n)
    _, bias, _ = planar_arm_terms(q, dq, gravity)
    plant.dynamics([*dq, *(sp.Matrix(tau) - bias)])
    plant.outputs(list(q), unit="rad")
    return plant


def _signals(
    plant: Plant, n: int
) -> tuple[tuple[sp.Symbol, ...], tuple[sp.Symbol, ...], tuple[sp.Symbol, ...]]:
    q = plant.states(f"q1:{n + 1}", range=(-0.3, 0.3), nominal=0, unit="rad")
    dq = plant.states(f"dq1:{n + 1}", range=(-0.5, 0.5), nominal=0, unit="rad/s")
    tau = plant.inputs(f"tau1:{n + 1}", range=(-1, 1), nominal=0, unit="N m")
    return q, dq, tau
