"""Options are held against their annotations; what is refused names option, value and remedy."""

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
import pytest

import obsynth as ob
from obsynth.designs.core.given import MATRIX, POSITIVE, Number, check_options
from obsynth.symbolic import ObsynthError

SHARE = Number(0.0, 1.0, because="a share lies between 0 and 1")


@dataclass(frozen=True)
class Options:
    form: Literal["corrected", "printed"] = "corrected"
    fine: Literal["row", "entry"] | None = None
    noise: bool = True
    order: int = 2
    share: Annotated[float, SHARE] = 0.5
    rate: Annotated[float | None, POSITIVE] = None
    weights: Annotated[tuple[float, ...] | None, Number(at_least=0.0)] = None
    turn: Annotated[Any | None, MATRIX] = None
    own: Any = None
    pairs: tuple[tuple[float, float], ...] | None = None

    def __post_init__(self) -> None:
        check_options(self)


def test_what_fits_is_kept_and_sequences_become_tuples():
    given = Options(fine="row", rate=3, weights=np.array([1, 2]), own=[1])
    assert given == Options(fine="row", rate=3.0, weights=(1.0, 2.0), own=[1])
    assert (type(given.rate), type(given.weights)) == (float, tuple)
    assert Options(weights=0.5).weights == (0.5,)
    assert Options(turn=np.eye(2)).turn == ((1.0, 0.0), (0.0, 1.0))
    assert hash(Options(turn=[3, 4])) == hash(Options(turn=[[3.0], [4.0]]))


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("form", "shortened", "one of 'corrected', 'printed'"),
        ("form", None, "one of"),
        ("fine", "column", "one of 'row', 'entry', None"),
        ("noise", 1, "one of True, False"),
        ("order", 2.5, "it has to be"),
        ("share", 1.0, "a share lies between 0 and 1"),
        ("share", 0.0, "a share lies between 0 and 1"),
        ("share", float("nan"), "a share lies between 0 and 1"),
        ("share", "half", "a share lies between 0 and 1"),
        ("share", True, "a share lies between 0 and 1"),
        ("rate", 0.0, "positive and finite"),
        ("rate", float("inf"), "positive and finite"),
        ("weights", [1.0, -1e-300], "it has to be"),
        ("weights", [[1.0]], "it has to be"),
        ("weights", [], "it has to be"),
        ("weights", "many", "it has to be"),
        ("weights", "12", "it has to be"),
        ("weights", True, "it has to be"),
        ("weights", [True, 1.0], "it has to be"),
        ("weights", np.array([1.0 + 1.0j]), "it has to be"),
        ("turn", [["1", "2"]], "no array of numbers"),
        ("turn", [[True]], "no array of numbers"),
        ("pairs", [(1, 0)], "pairs (lower, upper)"),
        ("pairs", [(float("nan"), 1)], "pairs (lower, upper)"),
        ("pairs", [(True, 1)], "pairs (lower, upper)"),
        ("pairs", [("0", "1")], "pairs (lower, upper)"),
        ("pairs", 3, "pairs (lower, upper)"),
        ("turn", "far", "no array of numbers"),
        ("turn", [[np.inf]], "finite numbers in 2 dimensions"),
        ("turn", np.ones((1, 1, 1)), "finite numbers in 2 dimensions"),
    ],
)
def test_what_does_not_fit_is_refused_by_name(name, value, said):
    with pytest.raises(ObsynthError, match=f"^{name} (is|has to hold) ") as refusal:
        Options(**{name: value})
    assert said in str(refusal.value)
    assert refusal.value.option == name


def test_limits_are_those_that_were_said():
    values = np.linspace(-1.0, 2.0, 61)
    assert [SHARE.holds(v) for v in values] == [0.0 < v < 1.0 for v in values]
    closed = Number(at_least=0.0, at_most=1.0)
    assert [closed.holds(v) for v in values] == [0.0 <= v <= 1.0 for v in values]
    assert SHARE.holds([0.1, 0.9]) and not SHARE.holds([0.1, 1.1])


IDLE = [
    (ob.SetAdaptiveObserver, {"robust": True}, {"Gamma": 0.02}),
    (ob.SetAdaptiveObserver, {"robust": True}, {"Gamma": (0.01, 0.01)}),
    (ob.SetAdaptiveObserver, {"robust": True}, {"law": "printed"}),
    (ob.SetAdaptiveObserver, {"robust": True}, {"gain_cap": 1.0}),
    (ob.SetAdaptiveObserver, {"robust": True}, {"noise": False}),
    (ob.SetAdaptiveObserver, {"robust": True}, {"window": 3.0}),
    (ob.SetAdaptiveObserver, {}, {"filters": (1.0,)}),
    (ob.SetAdaptiveObserver, {}, {"region": [(0, 1)]}),
    (ob.SetAdaptiveObserver, {"form": "printed"}, {"gain_cap": 1.0}),
    (ob.BoundedErrorUIO, {"bounds": "peak"}, {"post": "per_component"}),
    (ob.BoundedErrorUIO, {"bounds": "peak"}, {"objective": "log_det"}),
    (ob.BoundedErrorUIO, {"bounds": "peak"}, {"multipliers": "per_component"}),
    (ob.BoundedErrorUIO, {"bounds": "peak"}, {"error": "shifted"}),
    (ob.HinfUIO, {"mu": 1.0}, {"slack": 1e-3}),
    (ob.HinfUIO, {"method": "general"}, {"drop_zero_rows": False}),
]


@pytest.mark.parametrize(("method", "mode", "idle"), IDLE)
def test_options_without_effect_are_refused(method, mode, idle):
    """Mutant: a name left out of the list of what has no effect in a mode."""
    (name,) = idle
    with pytest.raises(ObsynthError, match=f"^{name} has no effect with ") as refusal:
        method(**mode, **idle)
    assert refusal.value.option == name
    assert method(**mode)
    again = {**method(**mode).options()}
    assert method(**again) == method(**mode)


@pytest.mark.parametrize(
    ("method", "options"),
    [
        (ob.BoundedErrorUIO, {"gamma": "x"}),
        (ob.SetAdaptiveObserver, {"noise": "no"}),
        (ob.HinfUIO, {"mu": True}),
        (ob.SetAdaptiveObserver, {"Gamma": (True, 1.0)}),
        (ob.FilterBank, {"filters": [True]}),
        (ob.IntervalObserver, {"prefer": 3}),
    ],
)
def test_types_of_options_are_checked(method, options):
    (name,) = options
    with pytest.raises(ObsynthError, match=f"^{name} is "):
        method(**options)


@pytest.mark.long
def test_a_point_is_taken_where_a_plant_is_split_and_refused_elsewhere():
    """Mutant: the nominal point in place of the given one."""
    plant = ob.plants.quadruple_tank().discretise("euler", Ts=1.0)
    at = np.array([150.0, 180, 40, 45]), np.array([11.0, 10])
    method = ob.BoundedErrorUIO(gamma=0.004)
    designs = [
        method.design(plant, at=at).certificate.design,
        method.design(ob.split(plant, at=at)).certificate.design,
    ]
    for design in designs:
        assert design.x_at.tolist() == at[0].tolist() and design.u_at.tolist() == at[1].tolist()
    assert np.array_equal(designs[0].A, designs[1].A)
    with pytest.raises(ObsynthError, match="at has no effect with this method"):
        ob.IntervalObserver().design(ob.plants.interval_example(), at=([0, 0, 0], [0]))
    with pytest.raises(ObsynthError, match="split already"):
        method.design(ob.split(plant), at=at)
