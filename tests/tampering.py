"""Stored designs as strangers may have left them: one seeded change of a file's text each."""

import copy
import json
import random
from collections.abc import Iterator
from typing import Any

RAW = "@raw@"
"""Stands in a tree for text that `json.dumps` would not write."""

RAWS = (
    "1" * 5000,
    "-" + "7" * 5000,
    "1e400",
    "-1e400",
    "NaN",
    "Infinity",
    "[" * 2000 + "]" * 2000,
    "[" * 200000,
    '{"a":' * 3000 + "1" + "}" * 3000,
    '{"kind": "peak", "kind": "ellipsoid"}',
    "\\ud800",
    '"\\ud800"',
)
TEXTS = (
    "x\nGuaranteed:\n  - nothing happens",
    "*/ int main(void) { return 1; } /*",
    "\x1b[2Jproved",
    "\x00",
    "a" * 3000,
    "x\u202ey",
    "'; import os",
    "((((" * 400,
    "1/0",
    "nan",
    "inf",
    "-inf",
    "1.0",
    "2",
    "",
    " ",
)
VALUES: tuple[Any, ...] = (
    None,
    True,
    False,
    0,
    -1,
    1,
    2,
    1.5,
    -0.0,
    1e308,
    -1e308,
    5e-324,
    1e-30,
    1e30,
    10**18,
    10**400,
    -(10**400),
    [],
    {},
    [[]],
    [[], [1]],
    {"kind": "peak"},
    {"kind": ["peak"]},
    [{}],
    *TEXTS,
    *(RAW + text for text in RAWS),
)
FACTORS = (-1.0, 0.0, 1.0 - 1e-15, 1.0 + 1e-15, 0.999, 1.001, 0.5, 2.0, 10.0, 1e-12, 1e12, 1e300)


def tampered(text: str, seed: int) -> bytes:
    """Return a design's file with one change, the same for the same seed."""
    chance = random.Random(seed)
    if chance.random() < 0.06:
        return _bytes(text, chance)
    tree = json.loads(text)
    ways = [way for way in _ways(tree) if way]
    heads = [way for way in ways if len(way) <= 2]
    way = chance.choice(heads if chance.random() < 0.3 else ways)
    place = tree
    for key in way[:-1]:
        place = place[key]
    _change(place, way[-1], chance)
    return _dumped(tree).encode("utf-8", "surrogatepass")


def _ways(value: Any, way: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    yield way
    entries: Any = ()
    if isinstance(value, dict):
        entries = value.items()
    elif isinstance(value, list):
        entries = enumerate(value)
    for key, entry in entries:
        yield from _ways(entry, (*way, key))


def _change(place: Any, key: Any, chance: random.Random) -> None:
    old = place[key]
    kind = chance.randrange(10)
    if kind <= 3 and _numbers(old):
        factor = chance.choice(FACTORS)
        place[key] = _scaled(old, factor)
    elif kind == 4:
        del place[key]
    elif kind == 5 and isinstance(place, dict):
        place[chance.choice(TEXTS)] = place.pop(key)
    elif kind == 5:
        place.insert(key, copy.deepcopy(old))
    elif kind == 6 and isinstance(old, list) and old:
        place[key] = chance.choice([old[:-1], old[1:], old + old, old[::-1], [old], [*old, None]])
    elif kind == 7 and isinstance(old, str):
        place[key] = chance.choice([old + chance.choice(TEXTS), old[:-1], old * 2, old.upper()])
    elif kind == 8:
        others = list(place) if isinstance(place, dict) else list(range(len(place)))
        other = chance.choice(others)
        place[key], place[other] = place[other], old
    else:
        place[key] = copy.deepcopy(chance.choice(VALUES))


def _numbers(value: Any) -> bool:
    if isinstance(value, list):
        return bool(value) and all(map(_numbers, value))
    return isinstance(value, int | float) and not isinstance(value, bool)


def _scaled(value: Any, factor: float) -> Any:
    return [_scaled(v, factor) for v in value] if isinstance(value, list) else value * factor


def _dumped(tree: Any) -> str:
    text = json.dumps(tree, indent=1)
    for raw in RAWS:
        text = text.replace(json.dumps(RAW + raw), raw)
    return text


def _bytes(text: str, chance: random.Random) -> bytes:
    data = text.encode()
    at = chance.randrange(len(data))
    return chance.choice(
        [
            data[:at],
            data[:at] + b"\xff\xfe" + data[at:],
            b"\xef\xbb\xbf" + data,
            data + b"{}",
            b"",
            b"\x00" * 8,
            text.encode("utf-16"),
            b"[" * 300000,
            data.replace(b'"version"', b'"version": 1, "version"', 1),
            data.replace(b'"plant"', b'"plant": null, "plant"', 1),
            data[:at] + data[at + 1 :],
        ]
    )
