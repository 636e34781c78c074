"""A plant whose matrices are given."""

import sympy as sp

import obsynth as ob


def lpv(A, F, C, **extra):
    """A plant with given matrices, noise of 0.01 and states within 5."""
    n, m = len(A), len(C)
    p = ob.Plant("given")
    x = p.states(f"x1:{n + 1}", range=(-5, 5), **extra)
    f = p.faults(f"f1:{len(F[0]) + 1}") if len(F[0]) else ()
    w = p.disturbances(f"w1:{n + 1}", bound=0.01)
    v = p.disturbances(f"v1:{m + 1}", bound=0.01)
    moved = sp.Matrix(A) * sp.Matrix(x) + sp.Matrix(w)
    p.dynamics(moved + (sp.Matrix(F) * sp.Matrix(f) if f else sp.zeros(n, 1)), Ts=1)
    p.outputs(sp.Matrix(C) * sp.Matrix(x) + sp.Matrix(v))
    return p
