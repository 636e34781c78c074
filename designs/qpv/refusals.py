"""What the printed conditions are worth: their solution, and where it fails."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from obsynth.designs.core.errors import CertificateError
from obsynth.designs.qpv.synthesis import Setting, solve
from obsynth.symbolic.arrays import FloatArray


@dataclass(frozen=True)
class Accepted:
    """What the LMI layer asks of a proof: whether it went through."""

    all_proved: bool


def printed_refusal(setting: Setting, gains: FloatArray | None = None) -> CertificateError:
    """Solve the printed inequalities and show what their solution does not satisfy."""
    unknowns, found = solve(setting, lambda _: Accepted(True), gains)
    P, sets = unknowns.P, setting.sets
    start = float(np.einsum("ki,ij,kj->k", sets.start, P, sets.start).max())
    normals = sets.normals.mid[:, 0, :]
    inside = float(np.einsum("ki,ik->k", normals, np.linalg.solve(P, normals.T)).max())
    letter = "mu" if setting.norm == "h2" else "gamma"
    return CertificateError(
        f"the conditions (19) and (20) as printed have the solution {letter} = "
        f"{found.objective:.6g}, and it does not prove what they are for",
        [
            "they describe e'P^-1 e <= 1, while V = e'P e decays",
            f"E = {{V <= 1}} has to lie in the polytope of the error: the largest "
            f"eta^2 a_k'P^-1 a_k is {inside:.6g}, above 1"
            if inside > 1
            else f"E lies in the polytope of the error ({inside:.6g})",
            f"P_e has to lie in E: the largest V at its corners is {start:.6g}"
            + (", above 1" if start > 1 else ""),
            'form="corrected" states both for V',
        ],
        mu=found.objective,
        P=P,
        gains={f"L{k}": gain for k, gain in enumerate(unknowns.gains, 1)},
        error_set=inside,
        start=start,
        solution=dict(found.values),
    )
