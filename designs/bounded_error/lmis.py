"""The error recursion (16) at every vertex of the Jacobian set and its inequalities, once.

``xi+ = (Abar_i - Kbar Cbar) xi + (Wbar_i - Kbar Vbar) v``, ``Kbar`` free, in any arithmetic; v is
scaled by its boxes, so Q_v of the paper is a diagonal of weights that sum to 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from obsynth.derive.errors import StructureError
from obsynth.derive.rigour import Enclosure, ExactMatrix
from obsynth.designs.lmi.problem import Arithmetic, block, he, lift, symmetric_block
from obsynth.symbolic.arrays import FloatArray

ErrorKind = Literal["plain", "shifted"]


@dataclass(frozen=True, eq=False)
class ModelData:
    """Everything numeric that the error system is formed from; E, T, Pi: of `Decoupling`.

    vertices, vertex_radius (N, n, n): every Jacobian is a combination of matrices within these
    """

    A: FloatArray
    B_f: FloatArray
    C: FloatArray
    W1: FloatArray
    W2: FloatArray
    E: FloatArray
    T: FloatArray
    Pi: FloatArray
    vertices: FloatArray
    vertex_radius: FloatArray
    w_radius: FloatArray
    rate: FloatArray

    def at(self, vertices: FloatArray) -> ModelData:
        """Return the same data with other vertices, as they are."""
        return replace(self, vertices=vertices, vertex_radius=np.zeros_like(vertices))

    def without_nonlinearity(self) -> ModelData:
        """Return the same data with the one vertex M = 0."""
        return self.at(np.zeros((1, *self.A.shape)))

    @property
    def sizes(self) -> tuple[int, int, int, int]:
        """n, n_f, m, n_w."""
        return self.A.shape[0], self.B_f.shape[1], self.C.shape[0], self.w_radius.size


@dataclass(frozen=True, eq=False)
class ErrorSystem:
    """Matrices of the error recursion, arrays or enclosures, one member per vertex.

    Abar (N, p, p), Cbar (m, p)
    Wbar (N, p, n_v) or (p, n_v), Vbar (m, n_v): of v in units of its boxes
    basis (n, p - n_f): state errors are ``basis @ xi[:p - n_f]``, and ``E W2 w_k`` where shifted
    blocks: 3 where v = (w_k, eps_k, w_{k+1}), 2 where v = (w_k, eps_k)
    """

    Abar: Any
    Cbar: Any
    Wbar: Any
    Vbar: Any
    basis: FloatArray
    blocks: int

    @property
    def sizes(self) -> tuple[int, int, int]:
        """p, m, n_v."""
        return self.Abar.shape[-1], self.Cbar.shape[-2], self.Vbar.shape[-1]

    def weighed(self, P: Any, H: Any) -> tuple[Any, Any]:
        """P Abar - H Cbar and P Wbar - H Vbar."""
        return P @ self.Abar - H @ self.Cbar, P @ self.Wbar - H @ self.Vbar

    def closed_loop(self, gain: Any) -> tuple[Any, Any]:
        """X = Abar - Kbar Cbar and Z = Wbar - Kbar Vbar for a given gain (p, m)."""
        return self.Abar - gain @ self.Cbar, self.Wbar - gain @ self.Vbar


def _parts(data: ModelData, arithmetic: Arithmetic) -> Mapping[str, Any]:
    """Return the matrices; unless they are floats, T and Pi are exactly I + E C, I + C E."""
    n, _, m, _ = data.sizes
    E, C = lift(data.E, arithmetic), lift(data.C, arithmetic)
    width = lift(np.diag(data.w_radius), arithmetic)
    T: Any
    Pi: Any
    M: Any
    if arithmetic == "float":
        T, Pi, M = data.T, data.Pi, data.vertices
    else:
        T, Pi = lift(np.eye(n), arithmetic) + E @ C, lift(np.eye(m), arithmetic) + C @ E
        if arithmetic == "exact":
            M = ExactMatrix.of(data.vertices[0])
        else:
            M = Enclosure.of(data.vertices, data.vertex_radius)
    return {
        "A": lift(data.A, arithmetic),
        "C": C,
        "T": T,
        "Pi": Pi,
        "E": E,
        "M": M,
        "W1s": lift(data.W1, arithmetic) @ width,
        "W2s": lift(data.W2, arithmetic) @ width,
    }


def kept_coordinates(T: FloatArray) -> list[int]:
    """Return the coordinates onto which T projects, for T = diag(0 or 1)."""
    diagonal = np.diag(T)
    if np.any(np.diag(diagonal) != T) or np.any((diagonal != 0) & (diagonal != 1)):
        raise StructureError(
            'error="shifted" needs an unknown input that takes away whole state coordinates '
            "(T = I + E C a diagonal of zeros and ones); here T mixes states, so rounding would "
            'leave the range of T: use error="plain" or bounds="peak"',
            T=T,
        )
    return [i for i, value in enumerate(diagonal) if value == 1]


def build_error_system(
    data: ModelData, error: ErrorKind, arithmetic: Arithmetic = "float"
) -> ErrorSystem:
    """Form the error system of a kind.

    plain: (16)-(18), xi = (e, e_f), v = (w_k, eps_k, w_{k+1}), with E W2 put right
    shifted: in zeta = T x - z (the method's page), in coordinates of the range of T
    """
    n, n_f, m, n_w = data.sizes
    part = _parts(data, arithmetic)
    T, E, W1s, W2s = (part[name] for name in ("T", "E", "W1s", "W2s"))

    def one(value: FloatArray) -> Any:
        return lift(value, arithmetic)

    basis, moved, driven = np.eye(n), T @ (part["A"] + part["M"]), T @ one(data.B_f)
    seen, read, noise = part["C"], W2s, [T @ W1s, one(np.zeros((n, n_f))), E @ W2s]
    if error == "shifted":
        basis = basis[:, kept_coordinates(data.T)]
        down = one(np.ascontiguousarray(basis.T))
        noise = [down @ (moved @ (E @ W2s) + T @ W1s), one(np.zeros((basis.shape[1], n_f)))]
        moved, driven = down @ moved @ one(basis), down @ driven
        seen, read = seen @ one(basis), part["Pi"] @ W2s
    late = [one(np.zeros((n_f, n_w)))] * (len(noise) - 2)
    own = [one(np.zeros((n_f, n_w))), one(np.diag(data.rate)), *late]
    return ErrorSystem(
        Abar=block([[moved, driven], [one(np.zeros((n_f, basis.shape[1]))), one(np.eye(n_f))]]),
        Cbar=block([[seen, one(np.zeros((m, n_f)))]]),
        Wbar=block([noise, own]),
        Vbar=block([[read, one(np.zeros((m, n_f + n_w * len(late))))]]),
        basis=basis,
        blocks=len(noise),
    )


def boundedness_block(P: Any, X: Any, Z: Any, keep: Any, noise: Any) -> Any:
    """Quadratic boundedness ``V+ <= (1 - gamma) V + gamma v'Q_v v`` at every vertex, not relaxed.

        [ keep P   *       *
          0        noise   *
          X        Z       P ]  > 0

    Shapes: P (p, p), keep = 1 - gamma (1, 1), noise = gamma Q_v (n_v, n_v); X and Z are P times
    the maps of the closed loop, ``P Abar - H Cbar`` and ``P Wbar - H Vbar`` with H = P Kbar.
    """
    return symmetric_block([[P * keep], [0, noise], [X, Z, P]])


def multiplier_block(
    data: ModelData,
    P: Any,
    H: Any,
    keep: Any,
    noise: Any,
    a: Any,
    b: Any,
    U: Any = None,
) -> Any:
    """Inequality (51), as printed or repaired, times -1; H (n + n_f, m), a, b, U (n, n)."""
    base, M = build_error_system(data.without_nonlinearity(), "plain"), data.vertices
    n, n_f, _, _ = data.sizes
    V, Y = np.eye(n, n + n_f), np.eye(n + n_f, n) @ data.T
    X, Z = base.weighed(P, H)
    S1 = P * keep - np.eye(n + n_f, n) @ he(a @ M) @ V
    rows = [[S1], [a @ V, b], [0, 0, noise], [-X, -(P @ Y), -Z, P]]
    if U is None:
        rows.append([-(b @ M @ V), 0, 0, 0, b])
    else:
        rows.append([-(U @ M @ V), 0, 0, 0, he(U) - b])
    return symmetric_block(rows)
