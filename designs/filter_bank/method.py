"""`FilterBank`: options of the method, and the way from a plant to an observer."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from obsynth.derive import Split
from obsynth.designs.core.given import POSITIVE
from obsynth.designs.core.method import Contract, Method
from obsynth.designs.filter_bank import claims, model, step
from obsynth.designs.filter_bank.model import CLASS, read
from obsynth.designs.filter_bank.record import BankDesign, BankModel
from obsynth.symbolic import Plant
from obsynth.symbolic.errors import ObsynthError

_DEFAULT_TS = 0.01
_SETTLED = 20.0
"""Time constants of the slowest filter for which a copy of the sets is kept at least."""


@dataclass(frozen=True)
class FilterBank(Method):
    """Intervals of states and of weighted means of faults by a bank of filters.

    For continuous plants whose equations are monotone in every signal that is not known at run
    time, every output showing one state, y = s x + v with s > 0, and every fault entering the
    equation of one measured state, alone in it, additively and with a constant factor.
    The flow of an unmeasured state has to fall with that state itself.

    Parameters
    ----------
    filters : sequence of float
        Rates of the filters per second. Slow filters have narrow intervals and long memories. The
        first one gives ``f_lower`` and ``f_upper``, unless zero lies in its interval and not in
        another one's.
    region : sequence of (float, float), optional
        Box of the states in which monotonicity is proved and which the bank assumes; the declared
        ranges by default.
    Ts : float, optional
        Sample time of `Observer.step`, .01 s by default.

    Raises
    ------
    ObsynthError
        For an option that is not known or out of range.

    Notes
    -----
    The bank answers what fails under noise in D. Efimov, T. Raissi, A. Zolghadri, "Set adaptive
    observers for linear parameter-varying systems: application to fault detection", J. Dynamic
    Systems, Measurement, and Control 136 (2014), for the same plants; it is not in the paper, and
    there is no program to be solved and nothing singular to be evaluated.

    Between two samples all states stay in an envelope X with X_0 + [0, Ts] f(X) inside X, whose
    containment every step checks; where it fails the bank begins anew. The unmeasured states come
    from both ends of their own monotone equations, which no fault enters. Every measured state x
    with a fault theta, x' = c + g theta, gets for every rate l filters

        z' = c + l (x - z),     N' = g - l N,     z(0) = x(0),     N(0) = 0,

    from below and from above, moved by their exact exponential. As x - z = N times the mean of
    theta with the weights exp(-l age), the interval

        [(x_lower - z_upper) / N, (x_upper - z_lower) / N]

    (its ends exchanged where g < 0) encloses that mean, however the fault moves: not its present
    value, unless it is constant. If the fault was zero since the filters began, so are all means:
    an interval without zero, of any filter, proves a fault. The intervals of all rates follow from
    the memory (`bank_intervals`).

    Examples
    --------
    >>> from obsynth.symbolic.plants import three_tanks
    >>> bank = FilterBank(region=[(0.2, 0.9), (0.0, 0.4), (0.1, 0.6)]).design(three_tanks())
    >>> bank.guarantee.claims[2]
    'x3 too, whatever the faults do'
    """

    CLASS = CLASS
    SPLITS = True
    CONTRACT = Contract.of("filter_bank", BankDesign, claims, model, step, step_covered=True)

    filters: Annotated[tuple[float, ...], POSITIVE] = (0.1, 0.2, 0.3, 0.5)
    region: tuple[tuple[float, float], ...] | None = None
    Ts: Annotated[float | None, POSITIVE] = None

    def read(self, given: Plant | Split) -> BankModel:
        """Prove over the region that the equations are monotone, and find where faults enter."""
        return read(given, self.region)

    def solve(self, model: BankModel) -> BankDesign:
        """Put the filters to what was read; there is nothing to be solved."""
        Ts = _DEFAULT_TS if self.Ts is None else self.Ts
        return BankDesign(
            **vars(model),
            Ts=Ts,
            filters=np.array(self.filters),
            options=self.settling(_SETTLED / min(self.filters), Ts),
        )

    def fix(self, model: BankModel, gains: Mapping[str, Any]) -> BankDesign:
        """Refuse gains, which a bank does not have."""
        raise ObsynthError("the bank has no gains: use design", option="gains")
