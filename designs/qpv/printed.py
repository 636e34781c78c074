"""What the paper prints: the gains of its example, and conditions that do not prove it."""

from typing import Literal

import numpy as np

from obsynth.designs.core.errors import CertificateError
from obsynth.designs.qpv.synthesis import Setting, solve_with_proof
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError

_FIRST = [
    """71.0525 -30.1291 -11.5840 103.3840 -24.6506 -19.2940 -120.2296 22.5926 42.0515
    110.9573 -96.8190 -33.2168 -27.9764 74.9819 21.2993 -97.3858 53.6423 44.2481""",
    """64.3704 -25.0137 -9.8594 86.1731 -10.3352 -14.5522 -85.2083 -8.2030 33.3839
    106.8744 -93.9764 -34.1212 -34.3997 81.1466 24.2239 -78.4953 37.2649 40.1757""",
    """75.4617 -35.8183 -13.0476 115.4117 -37.3239 -22.2768 -141.1897 44.7093 46.2986
    113.7898 -99.8003 -33.4420 -23.1945 69.9437 18.6991 -108.5528 65.4271 47.7827""",
]
_H2 = [
    """427.2646 -259.7506 -16.3848 -129.0876 549.1894 -14.4332 2.4575 2.3203 40.20427
    862.9942 -526.4240 -35.0245 -247.4478 1091.7887 -30.6016 0.1198 0.1033 31.6956""",
    """427.2820 -259.5539 -46.5346 -129.2089 547.9813 -0.7498 4.1287 2.3621 40.2119
    863.0264 -526.0396 -96.9897 -247.6797 1091.3691 -4.1523 0.2363 0.1062 31.6956""",
    """425.7364 -260.0593 -1.1649 -128.5972 549.3101 -51.8865 2.4981 4.1526 37.2134
    861.9118 -527.0171 -5.1480 -246.5044 1092.02101 -106.6068 0.1226 0.2310 31.6960""",
    """425.7576 -259.8632 -31.3115 -128.7288 548.1022 -38.2032 4.1696 4.1944 37.2211
    861.9515 -526.6341 -67.1056 -246.7571 1091.6018 -80.1577 0.2391 0.2340 31.6959""",
]
# L4 of the first list repeats L3, an error of copying.
_LISTS = {"first": [*_FIRST, _FIRST[2]], "H2": _H2}


def printed_gains(name: Literal["first", "H2"]) -> dict[str, FloatArray]:
    """Return the gains L1, ..., L4 that the paper prints for its example.

    Parameters
    ----------
    name : {"first", "H2"}
        The list; L4 of the first one repeats L3, an error of copying.

    Returns
    -------
    dict of str to ndarray, shape (6, 3)
        For `QPVObserver.analyse` of `obsynth.plants.qpv_example`.

    Raises
    ------
    ObsynthError
        Another name.

    References
    ----------
    Rotondo, Buciakowski, Witczak: Simultaneous state and process fault estimation in LPV systems
    using robust QPV observers, Section 5.

    Examples
    --------
    >>> from obsynth.designs import printed_gains
    >>> printed_gains("H2")["L1"][5].tolist()
    [0.1198, 0.1033, 31.6956]
    """
    if name not in _LISTS:
        raise ObsynthError(f"there are gains 'first' and 'H2', not {name!r}", name=name)
    return {
        f"L{k}": np.array(text.split(), dtype=float).reshape(6, 3)
        for k, text in enumerate(_LISTS[name], 1)
    }


def printed_refusal(setting: Setting, gains: FloatArray | None = None) -> CertificateError:
    """Solve the printed inequalities and show what their solution does not satisfy."""
    unknowns, found = solve_with_proof(setting, lambda _: True, gains)
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
