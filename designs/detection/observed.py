"""What a detector has and asks of its observer, and the numbers of samples that it is given."""

import operator
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from obsynth.designs.core.core import Core
from obsynth.designs.core.errors import DetectorError
from obsynth.designs.core.observer import STEP_OUTPUTS, Observer


class Handed(property):
    """What a detector has of its observer, under the same name."""

    def __init__(self, doc: str) -> None:
        super().__init__(doc=doc)

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, instance: Any, owner: type | None = None) -> Any:
        return self if instance is None else getattr(instance.observer, self.name)


def core_of(observer: Any) -> Core | None:
    """Return the core of an observer's step; None for a stand-in without a certificate."""
    contract = getattr(getattr(observer, "certificate", None), "contract", None)
    if contract is None or contract.build_core is None:
        return None
    core: Core = contract.build_core(observer.certificate.design)
    return core


def bounded_faults(observer: Observer) -> NDArray[np.bool_]:
    """Return which faults have an interval that anything measured can make narrower."""
    step, n_f = observer.step, len(observer.model.f)
    ports = [ca.SX.sym(name, step.numel_in(i)) for i, name in enumerate(step.name_in())]
    try:
        outputs = step.call(ports) if step.is_a("SXFunction") else step.expand().call(ports)
    except RuntimeError:
        # A step that has no scalar form cannot be looked into; its bounds are then taken as such.
        return np.ones(n_f, dtype=bool)
    layout = observer.memory_layout.items()
    own = [part for name, part in layout if not name.startswith(("f_lower", "f_upper"))]
    told = ca.vertcat(*ports[1:], *(ports[0][part] for part in own))
    lower, upper = (outputs[STEP_OUTPUTS.index(key)] for key in ("f_lower", "f_upper"))
    return np.array([_told(lower[i], told) and _told(upper[i], told) for i in range(n_f)])


def _told(bound: ca.SX, told: ca.SX) -> bool:
    slopes = ca.gradient(bound, told)
    return not all(slopes[i].is_zero() for i in range(slopes.numel()))


def whole_numbers(given: Any, names: tuple[str, ...], what: str = "persistence") -> tuple[int, ...]:
    """Return a number of samples for each fault."""
    values = tuple(given) if np.ndim(given) else (given,) * len(names)
    if len(values) != len(names):
        raise DetectorError(
            f"{what} has {len(values)} numbers for the {len(names)} faults {', '.join(names)}.",
            **{what: given},
        )
    try:
        whole = tuple(operator.index(value) for value in values)
    except TypeError:
        whole = (0,)
    if any(isinstance(value, bool) for value in values) or min(whole) < 1:
        raise DetectorError(
            f"{what}={given!r} is not a whole number of samples from 1 on.",
            **{what: given},
        )
    return whole
