"""Designs as plain data: what every method needs to write its record and to read it with care."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from obsynth.derive.jacobian.family import AffineFamily
from obsynth.designs.core.errors import CertificateError
from obsynth.designs.core.registry import FORMAT, VERSION
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray


def with_header(method: str, record: Mapping[str, Any]) -> dict[str, Any]:
    """Return a record with the header that `load` reads."""
    return {"format": FORMAT, "version": VERSION, "method": method, **record}


def plain(value: Any) -> Any:
    """Return a value as JSON-able data: plants, dataclasses, arrays and containers of them.

    What has a ``to_record`` of its own is asked for it.
    """
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Plant):
        return value.to_dict()
    if hasattr(value, "to_record"):
        return value.to_record()
    if is_dataclass(value) and not isinstance(value, type):
        return plain_fields(value)
    if isinstance(value, Mapping):
        return {key: plain(entry) for key, entry in value.items()}
    if isinstance(value, tuple | list):
        return [plain(entry) for entry in value]
    return value


def plain_fields(value: Any) -> dict[str, Any]:
    """Return the fields of a dataclass as JSON-able data, for a ``to_record`` of its own."""
    return {field.name: plain(getattr(value, field.name)) for field in fields(value)}


@contextmanager
def reading() -> Iterator[None]:
    """Turn whatever goes wrong while a record is read into one kind of refusal."""
    try:
        yield
    except CertificateError:
        raise
    except (KeyError, TypeError, ValueError, AttributeError, StopIteration) as error:
        raise CertificateError(f"the stored design cannot be read: {error!r}") from error


def read_array(values: Any, shape: tuple[int, ...], name: str) -> FloatArray:
    """Return finite numbers of a given shape."""
    array = np.asarray(values, dtype=float)
    if array.size == 0 and 0 in shape:
        array = np.zeros(shape)
    if array.shape != shape:
        raise CertificateError(
            f"{name} has shape {array.shape} in the stored design; {shape} is needed"
        )
    if not np.isfinite(array).all():
        raise CertificateError(f"{name} of the stored design is not finite")
    return array


def read_family(stored: Mapping[str, Any], shape: tuple[int, int]) -> AffineFamily:
    """Return the family of matrices of a given shape that was stored by `plain`."""
    directions = np.asarray(stored["directions"], dtype=float).reshape(-1, *shape)
    count = len(directions)
    family = AffineFamily(
        constant=read_array(stored["constant"], shape, "family.constant"),
        directions=read_array(directions, (count, *shape), "family.directions"),
        ranges=read_array(stored["ranges"], (count, 2), "family.ranges"),
        radius=read_array(stored["radius"], shape, "family.radius"),
        labels=tuple(map(str, stored["labels"])),
        exact=bool(stored["exact"]),
    )
    if family.radius.min(initial=0.0) < 0.0:
        raise CertificateError("family.radius of the stored design is negative")
    return family
