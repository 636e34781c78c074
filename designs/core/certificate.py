"""Certificates: what is claimed of a design, with margins and proofs that can be repeated."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from math import isclose, isfinite
from typing import TYPE_CHECKING, Any, Literal

from obsynth.designs.core.errors import CertificateError
from obsynth.designs.core.record import reading, shown
from obsynth.symbolic.shown import Shown, card
from obsynth.symbolic.table import Table, Tabled

if TYPE_CHECKING:
    from obsynth.designs.core.method import Contract
    from obsynth.designs.core.observer import Observer

Level = Literal["full", "lmi"]
LEVELS: tuple[Level, ...] = ("full", "lmi")


@dataclass(frozen=True)
class Claim:
    """One statement about a design and how it was proved.

    Attributes
    ----------
    name : str
        Short name, stable between versions (``"lmi"``, ``"decoupling"``, ...).
    statement : str
        The statement in words and the field's letters.
    holds : bool
        Whether the proof went through.
    margin : float
        How far the statement is from failing, in the units that ``proof`` names.
    proof : str
        By which means it was proved.
    """

    name: str
    statement: str
    holds: bool
    margin: float
    proof: str

    def __str__(self) -> str:
        word = "proved" if self.holds else "NOT PROVED"
        return f"{self.statement}: {word} (margin {self.margin:.3g}; {self.proof})"

    def to_record(self) -> dict[str, Any]:
        """Return the claim as JSON-able data, a margin that is not finite as None."""
        return {**asdict(self), "margin": self.margin if isfinite(self.margin) else None}

    def is_told_by(self, entry: Any) -> bool:
        """Whether a file lists this claim; what other processors round is not compared."""
        mine = self.to_record()
        margin, told = mine["margin"], entry.get("margin")
        told_too = set(entry) == set(mine) and isinstance(entry["proof"], str)
        same = told_too and all(entry[key] == mine[key] for key in ("name", "statement", "holds"))
        if margin is None or type(told) is not float:
            return same and type(told) is type(margin) and told == margin
        return same and isclose(told, margin, rel_tol=1e-2, abs_tol=1e-12)


@dataclass(frozen=True, repr=False)
class Guarantee(Shown):
    """What an observer promises, and under which assumptions.

    Attributes
    ----------
    claims : tuple of str
    assumptions : tuple of str
        Assumptions that the step monitors are marked ``[monitored]``.
    """

    claims: tuple[str, ...]
    assumptions: tuple[str, ...]

    def __str__(self) -> str:
        lines = ["Guaranteed:", *(f"  - {text}" for text in self.claims)]
        lines += ["provided that:", *(f"  - {text}" for text in self.assumptions)]
        return "\n".join(lines)

    def __repr__(self) -> str:
        return f"<Guarantee: {len(self.claims)} claims under {len(self.assumptions)} assumptions>"

    def _repr_html_(self) -> str:
        return card("Guaranteed", self.claims, card("provided that", self.assumptions))


@dataclass(frozen=True, eq=False, repr=False)
class Certificate(Tabled):
    """All claims of a design, bound to the record that they were proved for.

    Attributes
    ----------
    claims : tuple of Claim
    design : Record
        The stored design: everything the proofs use.
    contract : Contract
        Of the design's method: what is claimed of it and what runs.
    told : list of dict or None
        What the file that the design was read from lists as claims.
    """

    claims: tuple[Claim, ...]
    design: Any = field(repr=False)
    contract: Contract[Any] = field(repr=False)
    told: Any = field(default=None, repr=False)

    @cached_property
    def record(self) -> Mapping[str, Any]:
        """The stored design as JSON-able data."""
        return self.contract.to_record(self.design)

    def stored_as(self, record: Mapping[str, Any], told: Any) -> Certificate:
        """Return the certificate itself, read from a record in a file that lists claims too."""
        self.__dict__.update(record=record, told=told)
        return self.agreeing_with(told, "lmi")

    def agreeing_with(self, told: Any, level: Level) -> Certificate:
        """Return the certificate itself unless claims listed in a file contradict its own.

        What "lmi" does not prove is compared in a full check; no list, no contradiction.
        """
        mine = {claim.name: claim for claim in self.claims}
        listed = [] if told is None else told
        if not isinstance(listed, list) or not all(isinstance(entry, dict) for entry in listed):
            raise CertificateError("the claims that the file lists are no list of claims")
        names = [str(entry.get("name")) for entry in listed]
        for name, entry in zip(names, listed, strict=True):
            proved = name in mine and mine[name].is_told_by(entry)
            if names.count(name) > 1 or not (proved or (level == "lmi" and name not in mine)):
                found = mine.get(name, "no claim of that name")
                raise CertificateError(
                    f"the file lists the claim {shown(repr(name))}, which is not what is proved; "
                    "delete the list from the file to read the design without it",
                    [f"listed: {shown(repr(entry))}", f"proved: {found}"],
                )
        return self

    def __getstate__(self) -> tuple[Any, ...]:
        return self.claims, self.record, self.contract, self.told

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        claims, record, contract, told = state
        design = contract.record.from_record(record)
        self.__dict__.update(claims=claims, design=design, contract=contract, told=told)

    @property
    def valid(self) -> bool:
        """Whether every claim was proved."""
        return all(claim.holds for claim in self.claims)

    @property
    def margin(self) -> float:
        """The smallest margin of all claims."""
        return min((claim.margin for claim in self.claims), default=float("nan"))

    def __getitem__(self, name: str) -> Claim:
        for claim in self.claims:
            if claim.name == name:
                return claim
        raise KeyError(f"no claim {name!r}; there are {[c.name for c in self.claims]}")

    def __iter__(self) -> Iterator[Claim]:
        return iter(self.claims)

    def check(self, level: Level = "full") -> Certificate:
        """Prove every claim again from the stored record, without a solver.

        Parameters
        ----------
        level : {"full", "lmi"}
            ``"full"`` also derives the split and the Jacobian bounds from the
            stored equations again and shows that the stored vertices cover
            them; ``"lmi"`` starts from the stored vertices.

        Returns
        -------
        Certificate
            The claims of this check.

        Raises
        ------
        CertificateError
            If a claim cannot be proved; ``error.claims`` holds all of them.
        """
        if level not in LEVELS:
            raise CertificateError(f"level is {level!r}; it has to be one of {', '.join(LEVELS)}")
        # A copy, since a design keeps what was computed from its stored numbers before.
        with reading():
            certificate = self.contract.certify(replace(self.design), level).require()
            return certificate.agreeing_with(self.told, level)

    def observer(self) -> Observer:
        """Return the observer of the design.

        Raises
        ------
        CertificateError
            If a claim could not be proved.
        """
        return self.contract.observer(self)

    def require(self) -> Certificate:
        """Return the certificate itself if every claim holds.

        Raises
        ------
        CertificateError
            Naming the claims that could not be proved.
        """
        failed = [claim for claim in self.claims if not claim.holds]
        if failed:
            raise CertificateError(
                "the design is not certified:\n" + "\n".join(f"  - {claim}" for claim in failed),
                claims=self.claims,
                failed=tuple(failed),
            )
        return self

    def __str__(self) -> str:
        return "\n".join(str(claim) for claim in self.claims)

    def __repr__(self) -> str:
        return f"<{self.table().title}>"

    def table(self) -> Table:
        """Tabulate the claims with their margins and proofs."""
        proved = sum(claim.holds for claim in self.claims)
        return Table(
            f"Certificate: {proved} of {len(self.claims)} claims proved for the gains as stored",
            ["", "claim", "margin", "proof"],
            [["✓" if c.holds else "✗", c.statement, c.margin, c.proof] for c in self.claims],
        )
