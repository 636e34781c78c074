"""Lines about faults and about the Jacobian family for the structure report."""

from collections.abc import Callable

from obsynth.derive.jacobian.bounds import JacobianBounds
from obsynth.derive.split import Split
from obsynth.derive.structure.detectability import weakest_member
from obsynth.derive.structure.excitation import excitation
from obsynth.derive.structure.isolability import fault_isolability
from obsynth.derive.structure.zeros import zeros_over_polytope
from obsynth.symbolic.errors import ObsynthError
from obsynth.symbolic.plant import Plant

Line = tuple[str, bool | None, str]
_MOST_VERTICES = 512


def fault_lines(model: Plant) -> list[Line]:
    """Report which single faults show, which can be told apart, and what has to move for that."""
    if not model.f:
        return []

    def isolation() -> tuple[bool | None, str]:
        found = fault_isolability(model)
        if not found.detectable.all():
            return False, str(found)
        return (True if len(found.unique) == len(found.faults) else None), str(found)

    def movement() -> tuple[bool | None, str]:
        return None, str(excitation(model))

    return [_line("single faults", isolation), _line("excitation", movement)]


def family_lines(split: Split, bounds: JacobianBounds) -> list[Line]:
    """Report zeros at the vertices of the Jacobian family, and its weakest member."""
    lines: list[Line] = []
    count = bounds.family.vertex_count
    if count > _MOST_VERTICES:
        text = f"not looked at: the family has {count} vertices"
        return [("zeros at vertices", None, text)]

    def unknown() -> tuple[bool | None, str]:
        found = zeros_over_polytope(split, bounds, "unknown")
        return found.decays, str(found)

    def everything() -> tuple[bool | None, str]:
        return None, str(zeros_over_polytope(split, bounds, "all"))

    def weakest() -> tuple[bool | None, str]:
        return None, str(weakest_member(split, bounds))

    if split.model.d:
        lines.append(_line("zeros of unknown inputs", unknown))
    if split.model.f:
        lines.append(_line("zeros with faults", everything))
    if count > 1:
        lines.append(_line("weakest member", weakest))
    return lines


def _line(title: str, action: Callable[[], tuple[bool | None, str]]) -> Line:
    try:
        passed, text = action()
    except ObsynthError as error:
        return title, False, str(error)
    return title, passed, text
