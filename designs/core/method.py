"""What a method is: options that read and solve, and a contract for what they store.

A method is written as a folder with the files ``model`` (what is read of a plant), ``record``
(what is stored), ``lmis``, ``synthesis``, ``claims``, ``step`` and ``method``; `Method` and
`Contract` say what they owe, and the observer, its certificate, its file and its memory follow.
"""

import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from difflib import get_close_matches
from functools import partial
from inspect import signature
from types import ModuleType
from typing import Annotated, Any, ClassVar, Generic, Self, TypeVar

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from obsynth.derive import JacobianBounds, split
from obsynth.designs.core.certificate import Certificate, Claim, Guarantee, Level
from obsynth.designs.core.contractor import CUTS, EVERY_CUT
from obsynth.designs.core.core import Core
from obsynth.designs.core.errors import InfeasibleDesign
from obsynth.designs.core.given import Number, PlantClass, Start, check_options
from obsynth.designs.core.guard import MOST_CALLS, MOST_COUNTED, YOUNG, Guard, Watch, monitored
from obsynth.designs.core.observer import Observer
from obsynth.designs.core.record import Precision, plain, precision_of
from obsynth.designs.core.remainder import of_continuous, prove_remainder
from obsynth.designs.core.signals import held_in_single
from obsynth.designs.core.step import Step
from obsynth.designs.core.stepping import extended, fill
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError
from obsynth.symbolic.shown import card
from obsynth.symbolic.table import Table
from obsynth.symbolic.taking import takes

D = TypeVar("D")

CALLS = Number(
    at_least=1, at_most=MOST_CALLS, because="it has to be a number of calls, at least one"
)
WATCHED = ("horizon", "recovery", "cuts", "precision")
"""Options that every method has."""
FORMAT = "obsynth design"
VERSION = 2
_NUMBER = re.compile(r"\d+\.\d+(e[-+]?\d+)?")


@dataclass(frozen=True, eq=False)
class Numbers:
    """What an observer shows of itself; searched: entries that no claim proves."""

    gains: Mapping[str, FloatArray]
    performance: Mapping[str, Any]
    half_widths: FloatArray | None = None
    searched: tuple[str, ...] = ()


@dataclass(frozen=True)
class Contract(Generic[D]):
    """What a method owes for a design that is stored, each a function of the design alone.

    name: under which designs are stored
    record: type of the design, see `Record`; it has a `plant`
    read_again: what was read of the plant, derived anew from the stored equations
    claims: proofs of what the guarantee rests on, from the stored numbers
    covers: proofs that the stored numbers speak of the stored plant, from what was read of it
    memory_sizes: parts of the core's memory
    first_memory: parts of it for a first set; further keywords are those of the method. In discrete
        time the shared ones are enough, since a core begins from the first sets
    shared: parts of the memory that estimates are made of, or a function of the design
    build_ode: right-hand side for the core's memory, of methods in continuous time
    fault_delay, step_covered: see `Observer`; the former may be a function of the design
    settling: of a design, half widths of the sets that its core begins from, and a number of calls
        or None: how many calls its bounds take to settle, or that number, and its half widths from
        then on, all infinite where they cannot begin from such sets; None without any bounds
    quiet: whether a first set is for no fault where `memory0` is not told of any, not the ranges
    """

    name: str
    record: type[D]
    read_again: Callable[[D], Any]
    claims: Callable[[D], Iterable[Claim]]
    covers: Callable[[D, Any], Iterable[Claim]]
    guarantee: Callable[[D], Guarantee]
    numbers: Callable[[D], Numbers]
    memory_sizes: Callable[[D], Mapping[str, int]]
    first_memory: Callable[..., Mapping[str, ArrayLike]]
    build_core: Callable[[D], Core]
    shared: tuple[str, ...] | Callable[[D], tuple[str, ...]] = ()
    build_ode: Callable[[D], ca.Function] | None = None
    fault_delay: int | Callable[[D], int] = 0
    step_covered: bool = False
    settling: Callable[[D, FloatArray, int | None], tuple[int, FloatArray] | None] | None = None
    quiet: bool = False

    @classmethod
    def of(cls, name: str, record: type[D], *files: ModuleType, **more: Any) -> "Contract[D]":
        """Return the contract of functions that stand in files of a method under the names here."""
        found = [(one.name, vars(file).get(one.name)) for one in fields(cls) for file in files]
        return cls(name, record, **{k: value for k, value in found if callable(value)} | more)

    def to_record(self, design: Any) -> dict[str, Any]:
        """Return a design as JSON-able data with the header that `load` reads."""
        head = {"format": FORMAT, "version": VERSION, "method": self.name}
        return {**head, **plain(design)}

    def certify(self, design: Any, level: Level = "full", model: Any = None) -> Certificate:
        """Prove a design; `model`, what was read of the plant, spares deriving it again."""
        precision_of(design.options)  # a word that names none is refused before anything is proved
        claims = [*self.claims(design)]
        if level == "full" or model is not None:
            try:
                fresh = self.read_again(design) if model is None else model
                claims += self.covers(design, fresh)
                claims += prove_remainder(design.plant)
            except ObsynthError as error:
                said = "what was read of the plant can be derived from the stored equations"
                claims.append(Claim("derivation", said, False, -np.inf, str(error)))
        return Certificate(tuple(claims), design, self)

    def observer(self, certificate: Certificate) -> Observer:
        """Return what runs, for a certificate in which every claim holds."""
        design: Any = certificate.require().design
        plant: Plant = design.plant
        numbers, guard = self.numbers(design), self.guard(design)
        core, layout = self.build_core(design), guard.layout()
        performance = dict(numbers.performance)
        if numbers.half_widths is not None:
            performance["core_half_widths"] = numbers.half_widths
        told, searched = "predicted_half_widths", numbers.searched
        if guard.delay and guard.discrete and told not in performance:
            performance[told] = guard.widths(numbers.half_widths, nominal=True)
            searched = (*searched, told)
        ode = None if self.build_ode is None else self.build_ode(design)
        return Observer(
            method=self.name,
            model=plant if plant.Ts is not None else plant.discretise("rk4", design.Ts),
            step=Step(guard, core).build(),
            memory_layout=layout,
            gains=numbers.gains,
            performance=performance,
            half_widths=guard.widths(numbers.half_widths),
            certificate=certificate,
            guarantee=monitored(
                of_continuous(self.guarantee(design), plant), guard, core.mean_fault
            ),
            fault_delay=guard.delay,
            ode=None if ode is None else extended(ode, guard.sizes, layout, YOUNG),
            step_covered=self.step_covered,
            searched=searched,
        )

    def guard(self, design: Any) -> Guard:
        """Return what watches over the core of a design, in the ranges that it assumes."""
        plant: Plant = getattr(design, "assumed", design.plant)
        return Guard(
            plant,
            self.memory_sizes(design),
            Watch.of(design.options),
            self.fault_delay(design) if callable(self.fault_delay) else self.fault_delay,
            plant.Ts if plant.Ts is not None else design.Ts,
            self.shared(design) if callable(self.shared) else self.shared,
            None if self.settling is None else partial(self.settling, design),
        )

    def start(
        self,
        design: Any,
        guess: ArrayLike,
        x_range: ArrayLike | None = None,
        f_range: ArrayLike | None = None,
        y0: ArrayLike | None = None,
        **options: Any,
    ) -> FloatArray:
        """Return the memory for the first call of the step, see `Observer.memory0`."""
        known = [*signature(self.first_memory).parameters][2:]
        for option in set(options) - set(known):
            more = ", ".join(("guess, x_range, f_range, y0", *known))
            raise ObsynthError(
                f"memory0 of {self.name} takes {more}; it knows no {option!r}", option=option
            )
        given = Start.read(design.plant, guess, x_range, f_range, y0)
        guard, parts = self.guard(design), self.first_memory(design, given, **options)
        f_box = given.f if self.quiet or f_range is not None else design.plant.box("f")
        return fill(guard.layout(), guard.first(parts, given.x, f_box))


CONTRACTS: dict[str, Contract[Any]] = {}
"""Contracts of all methods that are defined, by name."""


@dataclass(frozen=True, eq=False)
class Method:
    """Options of a method, a frozen dataclass, and its way from a plant to an observer.

    A method has a `CLASS` of plants, a `CONTRACT`, and three verbs: `read`, `solve` and `fix`;
    `SPLITS` says whether it builds on a split of the plant.

    horizon: N, number of calls after which a set that was begun anew takes over from an older one:
        nothing that happened more than 2 N calls ago matters to what is returned. By default as
        many as the method's own sets take to settle, or 400
    recovery: number of calls after a void one that the status marks as recovering
    cuts: what the returned sets are cut with beside the method's own, of ``"ranges"``,
        ``"strips"``, ``"image"``, ``"inversion"``, ``"rates"`` and ``"sweeps"``: by default all but
        the last, which takes the most operations; ``()`` for the method's own sets, as its paper
        has them
    precision: in which the step runs, ``"double"`` or ``"single"``: sets hold the truth with every
        number and operation of the step rounded to it, readings too
    """

    CLASS: ClassVar[PlantClass]
    CONTRACT: ClassVar[Contract[Any]]
    SPLITS: ClassVar[bool] = False

    horizon: Annotated[int | None, CALLS] = field(default=None, kw_only=True)
    recovery: Annotated[int, CALLS] = field(default=10, kw_only=True)
    cuts: tuple[str, ...] | None = field(default=None, kw_only=True)
    precision: Precision = field(default="double", kw_only=True)

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        CONTRACTS[cls.CONTRACT.name] = cls.CONTRACT

    def __post_init__(self) -> None:
        check_options(self)
        named = CUTS if self.cuts is None else tuple(self.cuts)
        if isinstance(self.cuts, str) or not set(named) <= set(EVERY_CUT):
            raise ObsynthError(
                f"cuts is {self.cuts!r}; it takes a tuple of {', '.join(EVERY_CUT)}", option="cuts"
            )
        if self.precision == "single" and (self.horizon or 1) > MOST_COUNTED:
            raise ObsynthError(
                f"horizon is {self.horizon}; precision='single' counts up to {MOST_COUNTED}: take "
                "less, or precision='double'",
                option="horizon",
            )
        object.__setattr__(self, "cuts", None if self.cuts is None else named)
        self.check()

    def _repr_html_(self) -> str:
        def said(value: Any) -> str:
            return _NUMBER.sub(lambda found: f"{float(found[0]):.6g}", str(value))

        given = ((f.name, said(getattr(self, f.name)), said(f.default)) for f in fields(self))
        about = (type(self).__doc__ or "").strip().split("\n\n")[0]
        rows = [(name, value, "" if value == own else own) for name, value, own in given]
        return card(type(self).__name__, about, Table("", ("option", "value", "by default"), rows))

    def check(self) -> None:
        """Refuse options that do not fit each other, with an ObsynthError."""

    def read(self, *args: Any, **kwargs: Any) -> Any:
        """Read of a plant of the class what the method needs, structural conditions first."""
        raise NotImplementedError

    def solve(self, model: Any) -> Any:
        """Find a design for what was read, or refuse it."""
        raise NotImplementedError

    def __new__(cls, *_: Any, **options: Any) -> Self:
        """Refuse options that the method does not have, by name."""
        known = [field.name for field in fields(cls) if field.init]
        for name in options.keys() - known:
            near = get_close_matches(name, known, 1)
            raise ObsynthError(
                f"{cls.__name__} has no option {name!r}"
                + (f"; {near[0]!r} is meant" if near else f"; options are {', '.join(known)}"),
                option=name,
            )
        return super().__new__(cls)

    def fix(self, model: Any, gains: Mapping[str, ArrayLike]) -> Any:
        """Complete a design with given gains, or refuse them."""
        raise NotImplementedError

    @takes(model="Plant Split")
    def design(self, model: Any, bounds: JacobianBounds | None = None, at: Any = None) -> Observer:
        """Design, prove and return the observer.

        Parameters
        ----------
        model : Plant
            Or what `obsynth` derives from it and the method builds on: a `Split` for
            BoundedErrorUIO, HinfUIO, SetAdaptiveObserver and FilterBank, a `QuasiLPV` for
            IntervalObserver, a `QPV` for QPVObserver.
        bounds : JacobianBounds, optional
            Of the split's g, where they are at hand, for BoundedErrorUIO and HinfUIO.
        at : Equilibrium or (x, u), optional
            Point at which a plant is split, see `obsynth.split`, for methods that build on one.

        Returns
        -------
        Observer
            With a certificate in which every claim is proved.

        Raises
        ------
        StructureError
            If the plant is outside the class, or a rank or detectability condition fails; before
            anything is solved.
        InfeasibleDesign
            If no observer of this form exists; says what binds and what would help.
        UnboundedError
            If what has to be bounded is unbounded over the declared ranges.
        CertificateError
            If a claim cannot be proved, or for printed forms that do not prove what they claim.
        """
        if self.precision == "single" and isinstance(model, Plant):
            model = held_in_single(self.CLASS.check(model))
        if at is None:
            return self._design(model, bounds)
        if not self.SPLITS or not isinstance(model, Plant):
            what = "this method" if not self.SPLITS else "what is split already"
            raise ObsynthError(f"at has no effect with {what}: leave it out", option="at")
        return self._design(split(self.CLASS.check(model), at=at), bounds)

    def _design(self, model: Any, bounds: JacobianBounds | None) -> Observer:
        """Design, prove and return the observer."""
        found = self._checked(model, bounds)
        observer = self._certified(self.solve(found), found)
        if self.precision == "single" and observer.performance.get("core_half_widths") is not None:
            self._refuse_vacuous(observer, found)
        return observer

    def _refuse_vacuous(self, observer: Observer, model: Any) -> None:
        """Refuse half widths that are no less than what is declared, where those in doubles are."""
        names = (*observer.model.names("x"), *observer.model.names("f"))
        bare = observer.half_widths is None
        if not (bare or observer.vacuous):
            return
        other = replace(self, precision="double")
        double = other._certified(other.solve(model), model)
        if double.half_widths is None:
            return
        vacuous = names if bare else observer.vacuous
        lost = [name for name in vacuous if name not in double.vacuous]
        if lost:
            widths = observer.half_widths
            told = [
                f"{name}: +-{np.inf if widths is None else widths[names.index(name)]:.3g} in "
                f"single precision, +-{double.half_widths[names.index(name)]:.3g} in doubles"
                for name in lost
            ]
            raise InfeasibleDesign(
                f"rounding in single precision leaves nothing to say of {', '.join(lost)}: take "
                "precision='double'",
                told,
                option="precision",
            )

    @takes(model="Plant Split", gains="dict")
    def analyse(
        self,
        model: Any,
        gains: Mapping[str, ArrayLike],
        bounds: JacobianBounds | None = None,
    ) -> Observer:
        """Return what given gains guarantee, proved.

        Parameters
        ----------
        model : Plant
            As of `design`.
        gains : mapping of str to array_like
            By the letters of `Observer.gains`; the class says which are needed.
        bounds : JacobianBounds, optional
            As of `design`.

        Raises
        ------
        InfeasibleDesign
            If the gains are unstable, which is shown, or guarantee nothing.
        """
        if self.precision == "single" and isinstance(model, Plant):
            model = held_in_single(self.CLASS.check(model))
        found = self._checked(model, bounds)
        return self._certified(self.fix(found, gains), found)

    def options(self) -> Mapping[str, Any]:
        """Return the options by name, as a design stores them."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @property
    def watched(self) -> dict[str, Any]:
        """The options that every method has, by name."""
        return {name: getattr(self, name) for name in WATCHED}

    def settling(self, seconds: float, Ts: float) -> Mapping[str, Any]:
        """Return the options with a default horizon of so many seconds."""
        most = MOST_CALLS if self.precision == "double" else MOST_COUNTED
        calls = min(math.ceil(seconds / Ts), MOST_CALLS)
        calls = calls if calls == MOST_CALLS else min(calls, most)
        calls = calls if self.horizon is None else self.horizon
        return {**self.options(), "horizon": calls}

    def _checked(self, given: Any, bounds: JacobianBounds | None = None) -> Any:
        self.CLASS.check(given if isinstance(given, Plant) else given.model)
        return self.read(given) if bounds is None else self.read(given, bounds)

    def _certified(self, design: Any, model: Any) -> Observer:
        return self.CONTRACT.certify(design, model=model).observer()
