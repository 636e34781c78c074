"""Rotondo, Buciakowski, Witczak: what is printed of the QPV observer, and what holds."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from obsynth.designs import CertificateError, Ellipsoid, InfeasibleDesign, QPVObserver
from obsynth.designs.qpv.lmis import polya_terms
from obsynth.designs.qpv.printed import printed_gains
from obsynth.evaluate.papers.claim import Claim, close
from obsynth.evaluate.simulate import simulate
from obsynth.evaluate.truth import sample_time
from obsynth.symbolic import plants, scenarios

_Q = np.array([0.2, 0.2, 0.2, 0.1, 0.1, 0.1])
_CENTRE = np.array([10.0, 10.0, 10.0, 0.0, 0.0, 0.0])
_MU = 2.0024
_E0 = np.array([-1.0, -0.5, -2.0, 0.0, 0.0, 0.0])


def _method(kappa: float, **options: Any) -> QPVObserver:
    region, last = Ellipsoid(_Q, _CENTRE), np.eye(6)[[5]]
    return QPVObserver(
        region=region, performance_output=last, polytope="box", kappa=kappa, eta=0.2, **options
    )


def claims() -> Iterator[Claim]:
    """Solve the printed conditions and the corrected ones, and run the figures."""
    plant = plants.qpv_example()
    observer = _method(0.2).design(plant)
    try:
        _method(6.0**-0.5, form="printed").design(plant)
    except CertificateError as error:
        inside, mu = error.error_set, error.mu
        yield Claim(
            "(19), (20)",
            "the set {V <= 1} lies in the polytope of the error",
            f"largest eta^2 a_k'P^-1 a_k = {inside:.4g} at their optimum, where 1 is allowed",
            inside <= 1.0,
        )
        yield Claim(
            "Section 5",
            f"least mu = {_MU:g}",
            f"{mu:.4f} by (20) as printed, {observer.performance['mu']:.5f} by (20) for V",
            close(mu, _MU, 4),
        )
    try:
        _method(0.2**0.5).design(plant)
    except InfeasibleDesign as error:
        yield Claim(
            "Section 5",
            "a polytope of kappa^2 = .2, as mu needs, lies in the region",
            f"kappa^2 is at most {error.largest**2:.4f}",
            False,
        )
    P = observer.gains["P"]
    value = float(_E0 @ P @ _E0)
    yield Claim(
        "Section 5",
        "the first error (-1, -.5, -2, 0, 0, 0) is in the certified set",
        f"V = {value:.4g}, where 1 is allowed",
        value <= 1.0,
    )
    gains = printed_gains("first")
    copied = bool(np.array_equal(gains["L3"], gains["L4"]))
    said = "L4 repeats L3 to the last digit" if copied else "they differ"
    yield Claim("Section 5", "four gains L1 to L4", said, not copied)
    terms, reached = len(polya_terms(4, 2)), len(polya_terms(2, 2))
    yield Claim(
        "(47)",
        "1 <= p_k <= s tells all terms",
        f"{terms} for N = 4, s = 2, of which 1 <= p_k <= s reaches {reached}",
        reached == terms,
    )
    for name in ("FS0", "FS1", "FS2"):
        scenario = scenarios.qpv_example(name, Ts=sample_time(observer.model))
        run = simulate(observer.model, observer, scenario, engine="joint")
        offset = np.hstack([run.x, run.f]) - _CENTRE
        largest = float((offset**2 / _Q).sum(axis=1).max())
        yield Claim(
            f"Fig. 6, {name}",
            "the ellipsoid function stays below 1",
            f"it reaches {largest:.4g}",
            largest < 1.0,
        )
