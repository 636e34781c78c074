"""The five papers, by the names that the command takes."""

from collections.abc import Callable, Iterator

from obsynth.evaluate.papers import buciakowski, efimov, lamouchi, rotondo, witczak
from obsynth.evaluate.papers.claim import Claim

PAPERS: dict[str, tuple[str, Callable[[], Iterator[Claim]]]] = {
    "bounded-error": (
        "Buciakowski, Witczak, Puig, Rotondo, Nejjari, Korbicz: a bounded-error approach",
        buciakowski.claims,
    ),
    "hinf": ("Witczak, Korbicz, Jozefowicz: unknown input observers", witczak.claims),
    "qpv": ("Rotondo, Buciakowski, Witczak: robust QPV observers", rotondo.claims),
    "interval": ("Lamouchi, Raissi, Amairi, Aoun: interval observers", lamouchi.claims),
    "set-adaptive": ("Efimov, Raissi, Zolghadri: set adaptive observers", efimov.claims),
}
"""What each paper is called here, its title and the claims that are tried."""
