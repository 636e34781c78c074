"""Plants and observers as systems of python-control, and its systems as plants."""

import re
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import casadi as ca
import numpy as np

from obsynth.designs.core.observer import Observer
from obsynth.designs.detection.detector import FaultDetector
from obsynth.evaluate.checked import step_function
from obsynth.symbolic import Plant, PlantError
from obsynth.symbolic.arrays import FloatArray

_KINDS = ("u", "d", "f", "w", "p", "rho")


def from_control(
    system: Any,
    name: str | None = None,
    *,
    noise: Mapping[str, float] | None = None,
    **declared: Any,
) -> Plant:
    """Return the plant of a ``StateSpace`` or ``NonlinearIOSystem`` of python-control.

    Parameters
    ----------
    system : control.StateSpace or control.NonlinearIOSystem
        Functions of a nonlinear one are called once, with CasADi's symbols in place of numbers:
        arithmetic and NumPy's functions are followed, branches are not.
    name : str, optional
        That of the system by default.
    noise : mapping of output to float, optional
        Bounds of what is added to readings: disturbances ``noise_y`` of outputs y.
    **declared
        Ranges, units, nominal values as of ``Plant.from_casadi``: ``range={"x": (-1, 1)}`` by
        kind or by signal.

    Returns
    -------
    Plant
        Signals have the system's labels, other characters than letters and digits as underscores.
        Faults may be added to it.

    Raises
    ------
    PlantError
        Functions that do not take symbols, a time that stands in them, or noise of what is no
        output.

    Examples
    --------
    >>> import control
    >>> system = control.ss([[-1.0]], [[2.0]], [[1.0]], 0, states="h", inputs="v", outputs="y")
    >>> plant = from_control(system, noise={"y": 0.1}, range={"h": (0, 9), "v": (0, 4)})
    >>> plant.rhs, plant.output
    (Matrix([[-h + 2*v]]), Matrix([[h + noise_y]]))
    """
    labels = [system.state_labels, system.input_labels, system.output_labels]
    states, inputs, outputs = ([re.sub(r"\W", "_", label) for label in names] for names in labels)
    x, u = ([ca.SX.sym(n) for n in names] for names in (states, inputs))
    rows, shown = _rows(system, x, u)
    bounds = dict(noise or {})
    unknown = set(bounds) - set(outputs)
    if unknown:
        raise PlantError(
            f"noise has {min(unknown)!r}, which is no output; outputs are {', '.join(outputs)}"
        )
    w = {y: ca.SX.sym(f"noise_{y}") for y in outputs if y in bounds}
    if w:
        declared["bound"] = {f"noise_{y}": bounds[y] for y in w}
    shown = [row + w[y] if y in w else row for row, y in zip(shown, outputs, strict=True)]
    time = {"xdot": rows} if system.isctime() else {"xnext": rows, "Ts": _step(system)}
    return Plant.from_casadi(
        name or system.name,
        x=x,
        u=u or None,
        w=list(w.values()) or None,
        y=shown,
        output_names=outputs,
        **time,
        **declared,
    )


def _step(system: Any) -> float:
    # python-control writes True for a sample time that is not specified
    return 1.0 if system.dt is True else float(system.dt)


def _rows(system: Any, x: list[ca.SX], u: list[ca.SX]) -> tuple[list[ca.SX], list[ca.SX]]:
    """Return right-hand side and outputs of a system for symbols."""
    if hasattr(system, "A"):
        pairs = ((system.A, system.B), (system.C, system.D))
        made = [
            ca.DM(np.array(a)) @ ca.vertcat(*x) + ca.DM(np.array(b)) @ ca.vertcat(*u)
            for a, b in pairs
        ]
        return ca.vertsplit(ca.densify(made[0])), ca.vertsplit(ca.densify(made[1]))
    t, params = ca.SX.sym("t"), dict(system.params)
    given = [np.array([*part, None], dtype=object)[:-1] for part in (x, u)]
    found: list[list[ca.SX]] = []
    for what, function, count in (
        ("right-hand side", system.updfcn, len(x)),
        ("outputs", system.outfcn, system.noutputs),
    ):
        try:
            with warnings.catch_warnings():
                # CasADi announces what NumPy's functions of its symbols will return some day
                warnings.simplefilter("ignore", FutureWarning)
                rows = given[0] if function is None else function(t, *given, params)
            entries = [ca.SX(row) for row in np.ravel(np.array(rows, dtype=object)).tolist()]
        except Exception as error:
            raise PlantError(
                f"the {what} of {system.name} does not take symbols ({error}): write it with"
                " arithmetic and NumPy's functions, a branch as casadi.if_else, or type the plant"
            ) from error
        if len(entries) != count or any(ca.depends_on(row, t) for row in entries):
            raise PlantError(
                f"the {what} of {system.name} has {len(entries)} rows of {count}, or depends on the"
                " time; a plant is given by equations that do not change"
            )
        found.append(entries)
    return found[0], found[1]


def to_control(source: Plant | Observer | FaultDetector) -> Any:
    """Return a plant, or the step of an observer, as a ``NonlinearIOSystem`` of python-control.

    Parameters
    ----------
    source : Plant, Observer or FaultDetector

    Returns
    -------
    control.NonlinearIOSystem
        Of a plant: inputs u, d, f, w, p, rho by their names, outputs y. Of an observer: its memory
        as states (begin from ``observer.memory0(...)``), inputs u, y and measured scheduling;
        outputs ``h_hat``, ``h_lower``, ``h_upper`` of every state and fault h, and ``status``.

    Raises
    ------
    PlantError
        Without python-control (``pip install control``).

    Examples
    --------
    >>> import obsynth as ob
    >>> to_control(ob.plants.van_der_pol()).input_labels
    ['u', 'f']
    """
    return _of_plant(source) if isinstance(source, Plant) else _of_observer(source)


def _of_plant(plant: Plant) -> Any:
    function = plant.function()
    names = {kind: plant.names(kind) for kind in _KINDS}
    ends = np.cumsum([len(named) for named in names.values()])[:-1]

    def evaluate(i: int) -> Callable[..., FloatArray]:
        return lambda t, x, u, params: np.array(function(x, *np.split(u, ends))[i]).ravel()

    return _system(
        evaluate(0),
        evaluate(1),
        states=list(plant.names("x")),
        inputs=[name for named in names.values() for name in named],
        outputs=list(plant.output_names),
        dt=0 if plant.Ts is None else plant.Ts,
        name=plant.name,
    )


def _of_observer(observer: Observer | FaultDetector) -> Any:
    model = observer.model
    step = step_function(observer, model)
    sizes = [step.numel_in(i) for i in range(1, step.n_in())]
    ends = np.cumsum(sizes)[:-1]

    def evaluate(t: float, memory: FloatArray, u: FloatArray, params: Any) -> list[FloatArray]:
        return [np.array(part).ravel() for part in step(memory, *np.split(u, ends))]

    labels = [label for part in step.name_out()[1:] for label in observer.outputs[part]]
    measured = [s.name for s in model.rho if s.measured] if len(sizes) > 2 else []
    return _system(
        lambda *given: evaluate(*given)[0],
        lambda *given: np.concatenate(evaluate(*given)[1:]),
        states=[f"memory_{k}" for k in range(step.numel_in(0))],
        inputs=[*model.names("u"), *model.output_names, *measured],
        outputs=labels,
        dt=model.Ts,
        name=f"{observer.method} of {model.name}",
    )


def _system(update: Any, output: Any, **told: Any) -> Any:
    try:
        import control
    except ImportError:
        raise PlantError("python-control is not installed: pip install control") from None
    return control.nlsys(update, output, **told)
