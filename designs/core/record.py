"""Stored designs: dataclasses whose annotations say the shapes, written and read by one reader.

In ``K: Annotated[FloatArray, "n m"]`` letters stand for numbers of the plant's signals, see
`sizes_of`, or for the length that they meet first; sums like ``n+n_f-1`` are allowed.
"""

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, is_dataclass
from types import NoneType, UnionType
from typing import (
    Annotated,
    Any,
    ClassVar,
    Literal,
    Self,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np

from obsynth.derive.jacobian.family import AffineFamily
from obsynth.derive.rigour import Exact, from_text, to_text
from obsynth.designs.core.errors import CertificateError
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray, IntArray
from obsynth.symbolic.errors import ObsynthError

Precision = Literal["double", "single"]
"""IEEE format in which a step runs."""
ARRAYS = {FloatArray: float, IntArray: np.int64}
MOST_SHOWN = 400
"""Characters of a file that a refusal repeats."""


def sizes_of(plant: Plant) -> dict[str, int]:
    """Return the numbers of signals by the letters of shapes."""
    sizes = {f"n_{kind}": len(getattr(plant, kind)) for kind in ("u", "f", "w", "p", "rho")}
    return {"n": len(plant.x), "m": len(plant.output_names), "q": len(plant.d), **sizes}


@dataclass
class Context:
    """What is known while a record is read: the plant, and what the letters of shapes stand for."""

    plant: Plant | None = None
    sizes: dict[str, int] = field(default_factory=dict)

    def shape(self, letters: str, actual: tuple[int, ...]) -> tuple[int, ...]:
        """Return the shape that letters stand for; a new letter takes the length it meets."""
        words = letters.split()
        for word, length in zip(words, actual, strict=False):
            if word.isidentifier():
                self.sizes.setdefault(word, length)
        return tuple(map(self._size, words))

    def _size(self, word: str) -> int:
        parts = re.findall(r"([+-]?)(\w+)", word)
        sizes = [int(part) if part.isdigit() else self.sizes[part] for _, part in parts]
        return sum(-s if sign == "-" else s for (sign, _), s in zip(parts, sizes, strict=True))


class Record:
    """A dataclass that is stored: written by its fields, read by their annotations.

    KIND tells records apart where a field may hold one of several.
    """

    KIND: ClassVar[str | None] = None

    def to_record(self) -> dict[str, Any]:
        """Return the fields as JSON-able data."""
        kind = {} if self.KIND is None else {"kind": self.KIND}
        return {**kind, **plain_fields(self)}

    @classmethod
    def from_record(cls, stored: Mapping[str, Any], context: Context | None = None) -> Self:
        """Read what `to_record` wrote, every shape, number and word checked.

        Raises CertificateError, which says what cannot be read.
        """
        with reading():
            if cls.KIND is not None and stored["kind"] != cls.KIND:
                raise CertificateError(
                    f"the stored design has a part of kind {shown(repr(stored['kind']))} where "
                    f"{cls.KIND!r} is due"
                )
            found: Self = read_fields(cls, stored, Context() if context is None else context)
            found.check()
        return found

    def check(self) -> None:
        """Refuse what annotations cannot say, with a CertificateError."""


class Design(Record):
    """What is stored of an observer; its options say in which precision its step runs."""

    options: Mapping[str, Any]

    @property
    def precision(self) -> Precision:
        """In which precision the step runs."""
        return precision_of(self.options)


def precision_of(options: Mapping[str, Any]) -> Precision:
    """Return the precision that the options of a design name; without one it is double."""
    given: Precision = _read_literal(
        get_args(Precision), options.get("precision", "double"), "precision"
    )
    return given


@contextmanager
def reading() -> Iterator[None]:
    """Turn whatever goes wrong with a stranger's record into one kind of refusal."""
    try:
        yield
    except CertificateError:
        raise
    except Exception as error:
        said = str(error) if isinstance(error, ObsynthError) else repr(error)
        raise CertificateError(f"the stored design cannot be read: {shown(said)}") from error


def shown(value: Any) -> str:
    """Return what a record holds as a short line for a refusal."""
    text = value if isinstance(value, str) else repr(value)
    line = "".join(c if c.isprintable() else " " for c in text)
    return line if len(line) <= MOST_SHOWN else f"{line[:MOST_SHOWN]} ..."


def plain(value: Any) -> Any:
    """Return a value as JSON-able data: plants, records, dataclasses, arrays, containers."""
    if isinstance(value, np.ndarray) and value.dtype == object:
        return to_text(value)
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Plant):
        return value.to_dict()
    if hasattr(value, "to_record"):
        return value.to_record()
    if is_dataclass(value) and not isinstance(value, type):
        return plain_fields(value)
    if isinstance(value, Mapping):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, tuple | list):
        return [plain(entry) for entry in value]
    return value


def plain_fields(value: Any) -> dict[str, Any]:
    """Return the fields of a dataclass as JSON-able data."""
    return {one.name: plain(getattr(value, one.name)) for one in fields(value)}


def read_fields(cls: Any, stored: Mapping[str, Any], context: Context) -> Any:
    """Read a dataclass from its stored fields, in their order."""
    hints = get_type_hints(cls, include_extras=True)
    values = {
        one.name: read_value(hints[one.name], stored[one.name], one.name, context)
        for one in fields(cls)
    }
    return cls(**values)


def read_value(kind: Any, stored: Any, name: str, context: Context) -> Any:
    """Read one value as an annotation describes it."""
    shape = ""
    if get_origin(kind) is Annotated:
        kind, shape = get_args(kind)[:2]
    origin, inner = get_origin(kind), get_args(kind)
    if kind in ARRAYS:
        return _read_array(stored, shape, name, context, ARRAYS[kind])
    if kind == Exact:
        actual = np.array(stored, dtype=object).shape
        return from_text(stored, context.shape(shape, actual))
    if kind is AffineFamily:
        actual = np.asarray(stored["constant"], dtype=float).shape
        return read_family(stored, context.shape(shape, actual), name)
    if kind is Plant:
        context.plant = Plant.from_dict(stored)
        context.sizes |= sizes_of(context.plant)
        return context.plant
    if origin in (Union, UnionType):
        return _read_union(inner, stored, name, context, shape)
    if origin is Literal:
        return _read_literal(inner, stored, name)
    if origin is tuple:
        return _read_tuple(inner, stored, name, context)
    if origin is not None and issubclass(origin, Mapping):
        if inner[1] is Any:
            return dict(stored)
        return {
            key: read_value(inner[1], value, f"{name}.{key}", context)
            for key, value in stored.items()
        }
    if hasattr(kind, "from_record"):
        return kind.from_record(stored, context)
    if is_dataclass(kind):
        return read_fields(kind, stored, context)
    return _read_scalar(kind, stored, name)


def _read_array(stored: Any, letters: str, name: str, context: Context, kind: Any) -> Any:
    if not _all_numbers(stored):
        raise CertificateError(f"{name} of the stored design has to hold numbers only")
    array = np.asarray(stored, dtype=kind)
    if kind is not float and not np.array_equal(array, np.asarray(stored, dtype=float)):
        raise CertificateError(f"{name} of the stored design has to hold whole numbers")
    shape = context.shape(letters, array.shape)
    if array.shape == (0,) and 0 in shape:
        array = np.zeros(shape, dtype=kind)
    if array.shape != shape:
        raise CertificateError(
            f"{name} has shape {array.shape} in the stored design; {shape} is needed"
        )
    if not np.isfinite(array).all():
        raise CertificateError(f"{name} of the stored design is not finite")
    return array


def _all_numbers(stored: Any) -> bool:
    if isinstance(stored, list | tuple):
        return all(map(_all_numbers, stored))
    return isinstance(stored, int | float) and not isinstance(stored, bool)


def read_family(stored: Mapping[str, Any], shape: tuple[int, ...], name: str) -> AffineFamily:
    """Read a family of matrices of a given shape."""
    count = len(stored["directions"])
    context = Context(sizes={"K": count})
    rows, columns = shape

    def read(part: str, letters: str) -> FloatArray:
        array: FloatArray = _read_array(stored[part], letters, f"{name}.{part}", context, float)
        return array

    family = AffineFamily(
        constant=read("constant", f"{rows} {columns}"),
        directions=read("directions", f"K {rows} {columns}"),
        ranges=read("ranges", "K 2"),
        radius=read("radius", f"{rows} {columns}"),
        labels=_read_tuple((str, ...), stored["labels"], f"{name}.labels", context),
        exact=_read_scalar(bool, stored["exact"], f"{name}.exact"),
    )
    if family.radius.min(initial=0.0) < 0.0:
        raise CertificateError(f"{name}.radius of the stored design is negative")
    if np.any(family.ranges[:, 0] > family.ranges[:, 1]):
        raise CertificateError(f"a range of {name} of the stored design has lower above upper")
    return family


def _read_union(
    kinds: tuple[Any, ...], stored: Any, name: str, context: Context, shape: str
) -> Any:
    if stored is None and NoneType in kinds:
        return None
    rest = [kind for kind in kinds if kind is not NoneType]
    if len(rest) > 1:
        tags = {kind.KIND: kind for kind in rest}
        if stored["kind"] not in tags:
            raise CertificateError(
                f"{name} of the stored design is of kind {shown(repr(stored['kind']))}; "
                f"{', '.join(map(repr, tags))} are known"
            )
        return read_value(tags[stored["kind"]], stored, name, context)
    kind = Annotated[rest[0], shape] if shape else rest[0]
    return read_value(kind, stored, name, context)


def _read_literal(allowed: tuple[Any, ...], stored: Any, name: str) -> Any:
    for one in allowed:
        if type(stored) is type(one) and stored == one:
            return one
    raise CertificateError(
        f"{name} is {shown(repr(stored))} in the stored design; it has to be one of "
        f"{', '.join(map(repr, allowed))}"
    )


def _read_tuple(kinds: tuple[Any, ...], stored: Any, name: str, context: Context) -> Any:
    if len(kinds) == 2 and kinds[1] is Ellipsis:
        kinds = (kinds[0],) * len(stored)
    return tuple(
        read_value(kind, value, f"{name}[{k}]", context)
        for k, (kind, value) in enumerate(zip(kinds, stored, strict=True))
    )


def _read_scalar(kind: Any, stored: Any, name: str) -> Any:
    if kind is float and isinstance(stored, int | float) and not isinstance(stored, bool):
        if np.isfinite(stored):
            return float(stored)
    elif kind in (int, bool, str) and type(stored) is kind:
        return stored
    raise CertificateError(
        f"{name} is {shown(repr(stored))} in the stored design; "
        f"{'a finite ' if kind in (int, float) else ''}{kind.__name__} is needed"
    )
