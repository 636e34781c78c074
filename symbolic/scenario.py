"""Scenarios: what happens to a plant, as a value that simulation only runs."""

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import PlantError
from obsynth.symbolic.plant import Plant
from obsynth.symbolic.table import Table, Tabled
from obsynth.symbolic.taking import labelled

WORDS = {
    "u": "inputs",
    "d": "unknown_inputs",
    "f": "faults",
    "w": "disturbances",
    "rho": "scheduling",
}
"""What a scenario calls each kind of signals, in the order in which plants take them."""


@dataclass(frozen=True, eq=False, repr=False)
class Scenario(Tabled):
    """Initial state, inputs, faults and disturbances over the samples 0..steps.

    Parameters
    ----------
    name : str
        What plots and tables call it.
    steps : int
        N; the samples are 0..N.
    x0 : array (n,)
        The plant's true initial state.
    guess : array (n,)
        What the observer believes at the start.
    inputs : array (N+1, n_u) or callable
        Samples, or a function of k, or a feedback (k, y) for a plant without feed-through.
    faults : array (N+1, n_f) or callable k -> array, optional
        None: no fault.
    unknown_inputs : array (N+1, n_d) or callable k -> array, optional
        None: zero.
    scheduling : array (N+1, n_rho) or callable k -> array, optional
        None: nominal value, or the middle of the range.
    disturbances : array (N+1, n_w) or callable, optional
        A function of k, or a sampler (rng, k) that is called once for each sample. None:
        uniform in the declared box.
    x_range : array (n, 2), optional
        Box of the initial state that a design may assume.
    f_range : array (n_f, 2), optional
        Box of the initial fault that a design may assume.
    feedback : bool
        True when ``inputs`` is a function of (k, y); set by itself where it needs both.

    Notes
    -----
    An array holds its values from one sample to the next. A function of k is a function of
    time in samples, k = t / Ts: where plant and observer are integrated together it is read
    between the samples too, with a real k; everywhere else with the whole numbers 0..N.

    Raises
    ------
    PlantError
        Data that are not finite or not shaped for N + 1 samples.

    Examples
    --------
    >>> Scenario("step", 3, x0=[1], guess=[0], inputs=np.ones((4, 1))).steps
    3
    """

    name: str
    steps: int
    x0: FloatArray
    guess: FloatArray
    inputs: FloatArray | Callable[..., ArrayLike]
    faults: FloatArray | Callable[[float], ArrayLike] | None = None
    unknown_inputs: FloatArray | Callable[[float], ArrayLike] | None = None
    scheduling: FloatArray | Callable[[float], ArrayLike] | None = None
    disturbances: FloatArray | Callable[..., ArrayLike] | None = None
    x_range: FloatArray | None = None
    f_range: FloatArray | None = None
    feedback: bool = False

    def __post_init__(self) -> None:
        if isinstance(self.steps, bool) or not isinstance(self.steps, int) or self.steps < 1:
            raise PlantError(f"scenario {self.name!r}: steps={self.steps!r} is no positive integer")
        if callable(self.inputs) and _needed(self.inputs) == 2:
            object.__setattr__(self, "feedback", True)
        if self.feedback and not callable(self.inputs):
            raise PlantError(f"scenario {self.name!r}: a feedback is a function of (k, y)")
        object.__setattr__(self, "x0", self._array("x0", self.x0, (None,)))
        object.__setattr__(self, "guess", self._array("guess", self.guess, self.x0.shape))
        for field in ("inputs", "faults", "unknown_inputs", "scheduling", "disturbances"):
            value = getattr(self, field)
            if value is not None and not callable(value):
                object.__setattr__(self, field, self._array(field, value, (self.steps + 1, None)))
        for field, count in (("x_range", len(self.x0)), ("f_range", None)):
            value = getattr(self, field)
            if value is not None:
                box = self._array(field, value, (count, 2))
                if np.any(box[:, 0] > box[:, 1]):
                    raise PlantError(f"scenario {self.name!r}: {field} has lower above upper")
                object.__setattr__(self, field, box)

    def table(self) -> Table:
        """Tabulate what is given: values, the ranges of samples, what is a function."""
        given = {f.name: getattr(self, f.name) for f in fields(self)[2:-1]}
        rows = [
            (name.replace("_", " "), _told(value.T if name.endswith("range") else value))
            for name, value in given.items()
            if value is not None
        ]
        return Table(f"Scenario {self.name!r}, {self.steps} steps", ("", ""), rows)

    @property
    def functions(self) -> dict[str, Callable[[float], ArrayLike]]:
        """The signals that are given as functions of k, by the keys of :meth:`arrays`.

        Neither a feedback nor a sampler of disturbances is among them.

        Examples
        --------
        >>> sine = Scenario("sine", 3, x0=[1], guess=[0], inputs=lambda k: [np.sin(k)])
        >>> list(sine.functions)
        ['u']
        """
        given: dict[str, Any] = {key: getattr(self, field) for key, field in WORDS.items()}
        if self.feedback:
            del given["u"]
        if callable(self.disturbances) and self._sampled:
            del given["w"]
        return {key: value for key, value in given.items() if callable(value)}

    @property
    def _sampled(self) -> bool:
        """Whether the disturbances are a sampler (rng, k)."""
        return callable(self.disturbances) and _needed(self.disturbances, unknown=2) != 1

    def arrays(self, model: "Plant", seed: int | None = 0) -> dict[str, FloatArray | None]:
        """Return the samples of u, d, f, w and rho for a plant.

        Parameters
        ----------
        model : Plant
            Tells how many signals there are and where unspecified ones lie.
        seed : int, optional
            Seed of the disturbances.

        Returns
        -------
        dict
            Arrays (N+1, number of signals); ``u`` is None when the inputs are a feedback.

        Raises
        ------
        PlantError
            The scenario does not fit the plant, or an unbounded disturbance has no samples.

        Examples
        --------
        >>> from obsynth.symbolic.plants import quadruple_tank
        >>> from obsynth.symbolic.scenarios import quadruple_tank as scenario
        >>> scenario("FS1").arrays(quadruple_tank(), seed=0)["w"].shape
        (5001, 3)
        """
        if len(self.x0) != len(model.x):
            raise PlantError(
                f"scenario {self.name!r} has {len(self.x0)} initial states, "
                f"plant {model.name!r} {len(model.x)}"
            )
        if self.f_range is not None and len(self.f_range) != len(model.f):
            raise PlantError(
                f"scenario {self.name!r}: f_range has {len(self.f_range)} rows, plant "
                f"{model.name!r} {len(model.f)} faults"
            )
        u = None
        if not self.feedback:
            u = self._fit("inputs", self._samples("inputs"), model.names("u"))
        middle = [s.usual for s in model.rho]
        return {
            "u": u,
            "d": self._fit("unknown_inputs", self._samples("unknown_inputs"), model.names("d")),
            "f": self._fit("faults", self._samples("faults"), model.names("f")),
            "w": self._disturbances(model, seed),
            "rho": self._fit("scheduling", self._samples("scheduling"), model.names("rho"), middle),
        }

    def _disturbances(self, model: "Plant", seed: int | None) -> FloatArray:
        rng = np.random.default_rng(seed)
        samples = self.steps + 1
        if self.disturbances is None:
            box = model.box("w")
            if not np.all(np.isfinite(box)):
                raise PlantError(
                    f"scenario {self.name!r}: plant {model.name!r} has unbounded disturbances; "
                    "give disturbances= as samples or as a function (rng, k)"
                )
            return rng.uniform(box[:, 0], box[:, 1], (samples, len(box)))
        values = self.disturbances
        if callable(values) and self._sampled:
            values = self._called("disturbances", [values(rng, k) for k in range(samples)])
        else:
            values = self._samples("disturbances")
        rest = np.array([(s.lower, s.upper) for s in model.remainder or ()]).reshape(-1, 2)
        given = np.asarray(values, dtype=float) if np.ndim(values) == 2 else None
        if given is not None and len(rest) and given.shape[1] + len(rest) == len(model.w):
            # what a discretisation leaves out is nobody's to give
            middle = np.tile(rest.mean(axis=1), (len(given), 1))
            values = np.hstack([given, middle])
        return self._fit("disturbances", values, model.names("w"))

    def _samples(self, field: str) -> Any:
        """Return a field with a function of k replaced by its values at 0..N."""
        value = getattr(self, field)
        if not callable(value):
            return value
        return self._called(field, [value(k) for k in range(self.steps + 1)])

    def _called(self, field: str, rows: list[ArrayLike]) -> FloatArray:
        """Return what a function gave, one row per sample."""
        return self._array(field, [np.ravel(row) for row in rows], (self.steps + 1, None))

    def _fit(
        self, field: str, value: Any, names: tuple[str, ...], default: list[float] | None = None
    ) -> FloatArray:
        shape = (self.steps + 1, len(names))
        if value is None:
            return (
                np.broadcast_to(np.zeros(len(names)) if default is None else default, shape) + 0.0
            )
        if np.shape(value) != shape:
            raise PlantError(
                f"scenario {self.name!r}: {field} has shape {np.shape(value)}, "
                f"the plant needs {shape} ({', '.join(names) or 'no such signals'})",
                field=field,
            )
        return self._array(field, value, shape)

    def _array(self, field: str, value: Any, shape: tuple[int | None, ...]) -> FloatArray:
        if told := labelled(field, value):
            raise PlantError(f"scenario {self.name!r}: {told}", field=field)
        try:
            array = np.array(value, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise PlantError(
                f"scenario {self.name!r}: {field} is not an array of numbers ({error})",
                field=field,
            ) from error
        fits = array.ndim == len(shape) and all(
            want is None or have == want for have, want in zip(array.shape, shape, strict=True)
        )
        if not fits:
            wanted = ", ".join("any" if want is None else str(want) for want in shape)
            raise PlantError(
                f"scenario {self.name!r}: {field} has shape {array.shape}, not ({wanted})",
                field=field,
            )
        if not np.all(np.isfinite(array)):
            raise PlantError(f"scenario {self.name!r}: {field} holds non-finite data", field=field)
        array.flags.writeable = False
        return array


def known_name(name: str, known: Sequence[str], who: str) -> None:
    """Refuse a name that no scenario of a plant has."""
    if name not in known:
        raise PlantError(f"scenario {name!r} is unknown; {who} {', '.join(known)}", name=name)


def _told(value: Any) -> str:
    """Say what is given: entries of a vector, ranges of samples (N+1, count)."""
    if callable(value):
        return "a function"
    if value.ndim == 1:
        return f"({', '.join(f'{entry:.6g}' for entry in value)})"
    ends = zip(value.min(axis=0), value.max(axis=0), strict=True)
    return ", ".join(f"[{low:.6g}, {high:.6g}]" for low, high in ends)


def _needed(function: Callable[..., Any], unknown: int = 1) -> int:
    """Return how many arguments a function cannot do without."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except ValueError:
        return unknown
    positional = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    return sum(p.kind in positional and p.default is p.empty for p in parameters)
