"""Records: written by their fields, read by their annotations, damage refused by name."""

import copy
import json
from dataclasses import dataclass, fields, replace
from typing import Annotated, Any, Literal

import numpy as np
import pytest

import obsynth as ob
from methods import two_tanks
from obsynth.derive.jacobian.family import AffineFamily
from obsynth.derive.rigour import Exact, exact
from obsynth.designs.core.record import Record
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Round(Record):
    KIND = "round"

    radius: float


@dataclass(frozen=True, eq=False)
class Boxed(Record):
    KIND = "boxed"

    sides: Annotated[FloatArray, "n_b"]

    def check(self) -> None:
        if self.sides.min() < 0.0:
            raise ob.CertificateError("sides of the stored design are negative")


@dataclass(frozen=True, eq=False)
class Stored(Record):
    plant: Plant
    A: Annotated[FloatArray, "n n"]
    stack: Annotated[FloatArray, "k n m+2"]
    fewer: Annotated[FloatArray, "n-m 3-n+m"]
    again: Annotated[FloatArray, "k"]
    which: Annotated[IntArray, "m"]
    none: Annotated[FloatArray | None, "n"]
    thirds: Annotated[Exact, "m n"]
    family: Annotated[AffineFamily, "n n"]
    shape: Round | Boxed
    word: Literal["one", "two"]
    order: int
    table: dict[str, float]
    pair: tuple[float, str]
    options: dict[str, Any]


def stored() -> Stored:
    plant = two_tanks()
    return Stored(
        plant=plant,
        A=np.arange(4.0).reshape(2, 2),
        stack=np.ones((5, 2, 3)),
        fewer=np.array([[1.0, 2.0]]),
        again=np.arange(5.0),
        which=np.array([1]),
        none=None,
        thirds=exact(np.array([[1.0, 2.0]])) / 3,
        family=ob.jacobian_bounds(ob.split(plant)).family,
        shape=Boxed(np.array([1.0, 2.0])),
        word="two",
        order=3,
        table={"a": 0.1},
        pair=(1.5, "b"),
        options={"anything": [1, None]},
    )


def written() -> dict[str, Any]:
    text = json.dumps(stored().to_record(), allow_nan=False)
    record: dict[str, Any] = json.loads(text)
    return record


def test_what_is_read_is_what_was_written():
    before, after = stored(), Stored.from_record(written())
    for field in fields(Stored):
        if field.name not in ("plant", "family", "shape"):
            np.testing.assert_equal(getattr(after, field.name), getattr(before, field.name))
    assert json.dumps(after.to_record()) == json.dumps(before.to_record())
    assert (after.thirds == before.thirds).all()
    assert isinstance(after.shape, Boxed)
    other = replace(before, shape=Round(2.0), none=np.ones(2))
    again = Stored.from_record(json.loads(json.dumps(other.to_record())))
    assert isinstance(again.shape, Round)
    np.testing.assert_array_equal(again.none, np.ones(2))


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("A", [[1.0, 2.0]], r"A has shape \(1, 2\) in the stored design; \(2, 2\) is needed"),
        ("A", [[1.0, float("nan")], [0.0, 1.0]], "A of the stored design is not finite"),
        ("A", [[1.0, "x"], [0.0, 1.0]], "A of the stored design has to hold numbers only"),
        ("A", [[1.0, True], [0.0, 1.0]], "A of the stored design has to hold numbers only"),
        ("A", [[1.0, 2.0], [0.0]], "cannot be read"),
        ("stack", [[[1.0] * 4] * 2] * 5, "stack has shape"),
        ("fewer", [[1.0]], r"fewer has shape \(1, 1\) in the stored design; \(1, 2\) is needed"),
        ("again", [1.0] * 4, r"again has shape \(4,\) in the stored design; \(5,\) is needed"),
        ("which", [0.5], "which of the stored design has to hold whole numbers"),
        ("none", [1.0], "none has shape"),
        ("thirds", [["1/3", "x"]], "cannot be read"),
        ("thirds", [["1/3", "1e9"]], "'1e9' is no rational number"),
        ("thirds", [["1/3", 0.5]], "'0.5' is no rational number"),
        ("shape", {"kind": "flat"}, "shape of the stored design is of kind 'flat'"),
        ("shape", {"kind": "boxed", "sides": [-1.0]}, "are negative"),
        ("word", "three", "word is 'three' in the stored design; it has to be one of"),
        ("order", 1.5, "order is 1.5 in the stored design"),
        ("order", True, "order is True in the stored design"),
        ("table", {"a": "b"}, r"table\.a is 'b'"),
        ("table", {"a": True}, r"table\.a is True"),
        ("table", {"a": float("inf")}, r"table\.a is inf"),
        ("table", 3, "cannot be read"),
        ("pair", [1.0], "cannot be read"),
        ("plant", {"name": "x"}, "cannot be read"),
    ],
)
def test_damage_is_refused_by_name(name, value, said):
    with pytest.raises(ob.CertificateError, match=said):
        Stored.from_record({**written(), name: value})


def test_families_keep_their_laws():
    for part, value, said in (
        ("radius", -1.0, "family.radius of the stored design is negative"),
        ("ranges", None, "has lower above upper"),
    ):
        record = copy.deepcopy(written())
        if value is None:
            record["family"]["ranges"][0].reverse()
        else:
            record["family"][part][0][0] = value
        with pytest.raises(ob.CertificateError, match=said):
            Stored.from_record(record)


def test_a_field_that_is_missing_is_named():
    record = written()
    del record["word"]
    with pytest.raises(ob.CertificateError, match="cannot be read: KeyError\\('word'\\)"):
        Stored.from_record(record)
