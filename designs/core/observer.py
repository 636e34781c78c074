"""`Observer`: one certified run-time function and all that is known about it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from obsynth.designs.core.certificate import Certificate, Guarantee
from obsynth.designs.core.record import Precision, precision_of
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.shown import Shown, card, folded
from obsynth.symbolic.table import Table

if TYPE_CHECKING:
    from os import PathLike

    from obsynth.symbolic import Plant


STATUS: Mapping[str, int] = {
    "not_initialised": 1,
    "non_finite_input": 2,
    "outside_domain": 4,
    "void": 8,
    "fault_not_valid": 16,
    "measurement_left_out": 32,
    "recovering": 64,
}
"""Bits of the status that a step returns."""

STEP_OUTPUTS = (
    "memory_next",
    "xhat",
    "fhat",
    "x_lower",
    "x_upper",
    "f_lower",
    "f_upper",
    "status",
)
"""Names of the outputs of `Observer.step`, in their order."""

ALARM_OUTPUT = "alarm"
"""Name of the output that a fault detector's step has behind them."""

MEAN_OUTPUTS = ("mean_lower", "mean_upper", "mean_status")
"""Names of those behind the alarm, of a detector with a window."""

FURTHER_OUTPUTS = ((), (ALARM_OUTPUT,), (ALARM_OUTPUT, *MEAN_OUTPUTS))
"""What a step may have behind `STEP_OUTPUTS`."""


@dataclass(frozen=True, eq=False, repr=False)
class Observer(Shown):
    """A certified observer; `step` is the one truth at run time.

    Attributes
    ----------
    method : str
        The name under which the method is stored, ``"bounded_error_uio"``.
    model : Plant
        The discrete plant that the guarantee speaks of.
    step : casadi.Function
        ``(memory, u, y) -> (memory_next, xhat, fhat, x_lower, x_upper, f_lower,
        f_upper, status)``. Called at instant k with u_k and y_k it returns what
        is known about x_k and f_{k - fault_delay}, and the memory for k + 1.
    memory_layout : mapping of str to slice
        Which entries of the memory hold what.
    gains : mapping of str to ndarray
    performance : mapping of str to float
    half_widths : ndarray of shape (n + n_f,) or None
        Guaranteed steady half widths of the returned sets, states then faults; those of the
        method alone are ``performance["core_half_widths"]``. Where faults are known one call late,
        ``performance["predicted_half_widths"]`` are what is to be expected at the nominal point,
        without a guarantee.
    certificate : Certificate
    guarantee : Guarantee
    fault_delay : int
        0 or 1: how many samples the fault estimate lags behind.
    ode : casadi.Function or None
        Right-hand side of continuous-time methods.
    step_covered : bool
        Continuous-time methods: whether the guarantee covers the step too, called
        every `model.Ts` seconds on the continuous plant.
    searched : tuple of str
        Entries of `performance` that a search found and no claim proves.
    """

    method: str
    model: Plant
    step: ca.Function
    memory_layout: Mapping[str, slice]
    gains: Mapping[str, FloatArray]
    performance: Mapping[str, Any]
    half_widths: FloatArray | None
    certificate: Certificate
    guarantee: Guarantee
    fault_delay: int = 0
    ode: ca.Function | None = None
    step_covered: bool = False
    searched: tuple[str, ...] = ()

    @property
    def precision(self) -> Precision:
        """In which the step keeps its guarantee: ``"double"`` or ``"single"``."""
        return precision_of(self.certificate.design.options)

    @property
    def figures(self) -> Mapping[str, float]:
        """The numbers of the performance as they are shown: what no claim proves says so."""
        marks = dict.fromkeys(self.searched, " (searched, not proved)")
        return {
            key + marks.get(key, ""): value
            for key, value in self.performance.items()
            if isinstance(value, int | float)
        }

    @property
    def vacuous(self) -> tuple[str, ...]:
        """Names of states and faults whose half width is no less than what is declared."""
        boxes = np.vstack([self.model.box("x"), self.model.box("f").reshape(-1, 2)])
        declared = 0.5 * np.diff(boxes, axis=1)[:, 0]
        names = (*self.model.names("x"), *self.model.names("f"))
        found = (
            () if self.half_widths is None else zip(names, self.half_widths, declared, strict=True)
        )
        return tuple(name for name, width, limit in found if width >= limit)

    @property
    def widths(self) -> Mapping[str, str]:
        """The half widths in words, by the names of states and faults; vacuous ones say so."""
        if self.half_widths is None:
            return {}
        names = (*self.model.names("x"), *self.model.names("f"))
        found = {
            name: f"+-{width:.4g}" + (", no more than is declared" if name in self.vacuous else "")
            for name, width in zip(names, self.half_widths, strict=True)
        }
        near: Any = self.performance.get("predicted_half_widths")
        for k in () if near is None else np.flatnonzero(near < 0.99 * self.half_widths).tolist():
            found[names[k]] += f" (predicted at the nominal point: +-{near[k]:.4g})"
        return found

    @property
    def record(self) -> Mapping[str, Any]:
        """The stored design: everything that the certificate and the step are made from."""
        return self.certificate.record

    @property
    def outputs(self) -> Mapping[str, tuple[str, ...]]:
        """Labels of every output of the step, by the names of the plant's signals."""
        parts = [(kind, "hat") for kind in "xf"]
        parts += [(kind, end) for kind in "xf" for end in ("_lower", "_upper")]
        labels = {
            kind + end: tuple(f"{name}_{end.strip('_')}" for name in self.model.names(kind))
            for kind, end in parts
        }
        return {**labels, "status": ("status",)}

    def memory0(
        self,
        guess: Any,
        x_range: Any = None,
        f_range: Any = None,
        y0: Any = None,
        **options: Any,
    ) -> FloatArray:
        """Return the memory for the first call of `step`.

        Parameters
        ----------
        guess : array_like of shape (n,)
            Where the state is thought to be.
        x_range : array_like of shape (n, 2), optional
            Box that holds the first state; the declared ranges by default.
        f_range : array_like of shape (n_f, 2), optional
            Box that holds the first faults. By default zero (no fault at the start) for
            BoundedErrorUIO and QPVObserver, the declared ranges for the others.
        y0 : array_like of shape (m,), optional
            The first measurement, for methods that start from it.
        **options
            What else the method offers, see its documentation.

        Returns
        -------
        ndarray of shape (n_memory,)
        """
        certificate = self.certificate
        return certificate.contract.start(
            certificate.design, guess, x_range, f_range, y0, **options
        )

    def save(self, path: str | PathLike[str]) -> None:
        """Store the design as JSON; the file is replaced only when complete.

        See Also
        --------
        obsynth.load
        """
        from obsynth.designs.core.files import save

        save(self, path)

    def __str__(self) -> str:
        lines = [f"{self.method} for {self.model.name}"]
        if self.widths:
            lines.append("  " + ", ".join(f"{name} {word}" for name, word in self.widths.items()))
        lines += [f"  {key} = {value:.6g}" for key, value in self.figures.items()]
        return "\n".join([*lines, *([f"  {self._advice}"] if self.vacuous else [])])

    @property
    def _advice(self) -> str:
        told = ", ".join(self.vacuous)
        return f"says no more of {told} than is declared: obsynth.choose tries the other methods"

    def _repr_html_(self) -> str:
        first, *_ = str(self).splitlines()
        told = [*self.widths.items(), *((k, f"{v:.6g}") for k, v in self.figures.items())]
        return card(
            first,
            Table("", ("", ""), told),
            self._advice if self.vacuous else "",
            self.certificate,
            folded("Guarantee", self.guarantee),
        )
