"""Witczak, Korbicz, Jozefowicz: what is printed of the H-infinity observer, and what holds."""

from collections.abc import Iterator

import numpy as np

from obsynth.derive import jacobian_bounds, split
from obsynth.designs import HinfUIO, InfeasibleDesign
from obsynth.evaluate.papers.claim import Claim, close
from obsynth.symbolic import plants

_K = np.array([[0.4885, 2.0619], [0.0, 0.0], [0.9724, 1.0753]])
_MAJORANT = (0.0, 0.517, 0.1089)
_MU = 0.499


def claims() -> Iterator[Claim]:
    """Try the example for both g: that of (50), and that to which (51) to (53) belong."""
    printed = HinfUIO(form="printed", majorant=_MAJORANT, slack=1e-6)
    read = {}
    for variant in ("consistent", "as_printed"):
        plant = plants.hinf_example(variant)
        parts = split(plant, at=(np.zeros(3), np.zeros(1)), linear="terms")
        read[variant] = parts, jacobian_bounds(parts)
    for variant, letter in (("consistent", "cos(12 x2)"), ("as_printed", "cos(12 x1), (50)")):
        bounds = read[variant][1]
        squares = np.maximum(-bounds.min, bounds.max)[[0, 2], [1, 2]] ** 2
        other = float(np.maximum(-bounds.min, bounds.max)[0, 0])
        fits = bool(
            other < 1e-12 and squares[0] <= _MAJORANT[1] and squares[1] <= _MAJORANT[2] + 1e-12
        )
        entries = f"{squares[0]:.6f}, {squares[1]:.6f}"
        yield Claim(
            f"(52), g with {letter}",
            "M'M = diag(0, .517, .1089) bounds the Jacobian of g",
            f"squares of entries (1,2), (3,3) and (1,1) reach {entries}, {other**2:.4f}",
            fits,
        )
    level = printed.analyse(read["consistent"][0], {"K": _K}).performance["l2_gain"]
    yield Claim(
        "(53), g with cos(12 x2)",
        f"K attains mu = {_MU:g} by (45)",
        f"certified for K as printed: {level:.5f}",
        level <= _MU + 5e-4,
    )
    parts, bounds = read["as_printed"]
    try:
        found = HinfUIO(method="polytopic").analyse(parts, {"K": _K}, bounds)
        said, stable = f"stable, gain {found.performance['l2_gain']:.4g}", True
    except InfeasibleDesign as error:
        said, stable = f"unstable: spectral radius {error.spectral_radius:.4f} at a Jacobian", False
    yield Claim("(53), g with cos(12 x1), (50)", "the error is stable with K", said, stable)
    best = printed.design(*read["consistent"]).performance["least_mu"]
    yield Claim("(45)", f"least mu = {_MU:g}", f"{best:.6f}", close(best, _MU, 3))
    plain = HinfUIO(form="printed", majorant=(_MAJORANT[1],) * 3)
    wide = plain.design(*read["consistent"]).performance["least_mu"]
    yield Claim(
        "(14)",
        "gamma^2 I may stand for M'M",
        f"least mu {wide:.4f} with it, {best:.4f} without",
        close(wide, best, 2),
    )
