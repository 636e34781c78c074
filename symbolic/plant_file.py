"""A plant as a text file in TOML: signals by their roles, equations as strings.

::

    name = "tank"

    [states]
    h = { range = [10, 100], unit = "cm" }

    [inputs]
    v = { range = [0, 10], nominal = 5, unit = "V" }

    [actuator_faults]
    f = { of = "v", rate = 0.01 }

    [disturbances]
    w = { bound = "1/10", unit = "cm" }

    [definitions]
    outflow = "sqrt(h)/10"

    [dynamics]
    h = "v/10 - outflow"

    [outputs]
    y = { is = "h + w", unit = "cm" }

Tables and keywords are those of the declarations of `Plant`; a key may stand for several signals
(``"w1:4"``). Numbers may be text and are exact then. ``Ts`` beside the name says that the equations
are those of next values, ``[discretise]`` takes what `Plant.discretise` takes. Nothing is evaluated
but by the grammar of `text`.
"""

import difflib
import os
import re
import tomllib
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, NoReturn

import sympy as sp

from obsynth.symbolic.delays import Delays
from obsynth.symbolic.errors import ObsynthError, PlantError
from obsynth.symbolic.pieces import Made
from obsynth.symbolic.plant import Plant
from obsynth.symbolic.signals import Role, expand_names, is_name
from obsynth.symbolic.text import TextError, read_text

_TOKEN = re.compile(
    r"#[^\n]*"
    r'|"""(?:\\.|[^\\])*?"""|' + r"'''.*?'''"
    r'|"(?!"")(?:\\.|[^"\\\n])*"|' + r"'(?!'')[^'\n]*'"
    r"|(?P<open>\[|\{|\"\"\"|'''|\"|')|(?P<close>\]|\})",
    re.DOTALL,
)
_PAIR = {"]": "[", "}": "{"}
_FAULT = {"range", "rate", "constant", "unit"}
_ROLES: Mapping[str, tuple[Role, set[str]]] = {
    "states": (Role.STATE, {"range", "unit", "nominal"}),
    "inputs": (Role.INPUT, {"range", "unit", "nominal"}),
    "unknown_inputs": (Role.UNKNOWN_INPUT, {"range", "unit", "nominal"}),
    "parameters": (Role.PARAM, {"value", "tolerance", "range", "unit", "constant"}),
    "scheduling": (Role.SCHEDULING, {"range", "unit", "measured", "nominal"}),
    "disturbances": (Role.DISTURBANCE, {"bound", "range", "unit"}),
    "actuator_faults": (Role.ACTUATOR_FAULT, {"of", *_FAULT}),
    "sensor_faults": (Role.SENSOR_FAULT, {"of", *_FAULT}),
    "process_faults": (Role.PROCESS_FAULT, _FAULT),
}
_WORDS = {"name", "about", "Ts"}
_TABLES = {*_ROLES, "definitions", "dynamics", "outputs", "discretise"}
BESIDE = ("design", "scenario", "record")
"""Tables that say what is done with the plant."""
_OUTPUT = {"is", "unit", "range"}
_STEP = {"method", "Ts", "order", "remainder"}
_TEXTS = {"unit", "of", "method", "is"}
_HEADER = re.compile(r"\s*\[\s*([^\[\]]+?)\s*\]\s*(#.*)?$")
_KEY = re.compile(r"\s*([A-Za-z0-9_.-]+|\"[^\"]*\"|'[^']*')\s*=")
_MOST = 1_000_000
Keys = tuple[str, ...]


def unclosed(text: str) -> tuple[str, int] | None:
    """Return the bracket or quote that stays open, and where; None if none or one too few does."""
    stack: list[tuple[str, int]] = []
    for token in _TOKEN.finditer(text):
        opening, closing = token["open"], token["close"]
        if opening is not None:
            stack.append((opening, token.start()))
            if opening not in "[{":
                return stack[-1]
        elif closing is not None:
            last = stack.pop() if stack else ("", 0)
            if last[0] != _PAIR[closing]:
                return last if _PAIR[closing] in (bracket for bracket, _ in stack) else None
    return stack[-1] if stack else None


def read_plant(path: str | os.PathLike[str]) -> Plant:
    r"""Read a plant from a TOML file.

    Parameters
    ----------
    path : path
        See the documentation on plants as text; ``obsynth new`` writes a commented one.

    Returns
    -------
    Plant
        Discretised where the file has a table ``[discretise]``.

    Raises
    ------
    PlantError
        With ``line`` and ``column`` of what cannot be read, both from 1.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     file = Path(folder, "decay.toml")
    ...     _ = file.write_text(
    ...         'name = "decay"\n[states]\nx = { range = [1, 2] }\n'
    ...         '[dynamics]\nx = "-x/2"\n[outputs]\ny = "x"\n'
    ...     )
    ...     read_plant(file).rhs
    Matrix([[-x/2]])
    """
    return PlantText(read_text_file(path), Path(path).name).plant()


def read_text_file(path: str | os.PathLike[str]) -> str:
    """Return the text of a small file, or refuse what is none."""
    data, name = Path(path).read_bytes(), Path(path).name
    if len(data) > _MOST:
        raise PlantError(f"{name} has {len(data)} bytes; a plant has at most {_MOST}")
    try:
        return data.decode()
    except UnicodeDecodeError as error:
        raise PlantError(f"{name} is no text in UTF-8 ({error})") from error


class PlantText:
    """The text of a plant, and where in it things stand.

    where: what messages call it
    """

    def __init__(self, text: str, where: str) -> None:
        self.text, self.where = text.replace("\r\n", "\n"), where
        try:
            self.data: dict[str, Any] = tomllib.loads(self.text)
        except tomllib.TOMLDecodeError as error:
            found = re.search(r"\(at (?:line (\d+), column (\d+)|end of document)\)", str(error))
            place = len(self.text)
            if found is not None and found[1] is not None:
                lines = self.text.split("\n")[: int(found[1]) - 1]
                place = sum(len(line) + 1 for line in lines) + int(found[2]) - 1
            message = str(error).split(" (at")[0]
            if (open_one := unclosed(self.text)) is not None and open_one[1] < place:
                line = self.text.count("\n", 0, place) + 1
                message = f"the {open_one[0]} is not closed; noticed in line {line}: {message}"
                place = open_one[1]
            message += "; equations stand in quotes, tables in [brackets] or in a line of { }"
            self._fail_at(place, message)
        self._places = self._index()
        self._more: dict[str, Made] = {}

    def plant(self) -> Plant:
        """Return the plant that the text says."""
        self.known((), self.data, {*_WORDS, *_TABLES, *BESIDE})
        for word in {*_TABLES, *BESIDE} & set(self.data):
            self.table((word,), self.data[word])
        for word in ("name", "about"):
            if not isinstance(self.data.get(word, "-"), str):
                self.fail((word,), f"{word} is text, not {self.data[word]!r}")
        if "name" not in self.data:
            self.fail((), 'the plant has no name: write name = "..." in the first line')
        plant: Plant = self.tried(("name",), Plant, self.data["name"])
        for table in self.data:
            if table in _ROLES:
                self._declare(plant, table)
        symbols: dict[str, sp.Expr] = {signal.name: signal.symbol for signal in plant.signals}
        delays = Delays(plant)
        self._more = {"delayed": (delays if "Ts" in self.data else _no_steps, 2, 2)}
        for name, text in self.data.get("definitions", {}).items():
            path = ("definitions", name)
            if not is_name(name) or name in symbols:
                self.fail(path, f"a definition has a name of its own, not {name!r}")
            symbols[name] = self.expression(path, text, symbols)
        self._equations(plant, symbols, delays)
        self._more = {}
        step = self.data.get("discretise")
        if step is None:
            return plant
        options = self._fields(("discretise",), step, _STEP)
        for word in ("method", "Ts"):
            if word not in options:
                self.fail(("discretise",), f"[discretise] needs {word}")
        sampled: Plant = self.tried(("discretise",), plant.discretise, **options)
        return sampled

    def _declare(self, plant: Plant, table: str) -> None:
        """Declare the signals of one table."""
        role, words = _ROLES[table]
        for names, entry in self.data[table].items():
            path = (table, names)
            given = entry
            if role is Role.PARAM and not isinstance(entry, dict):
                given = {"value": entry}
            fields = self._fields(path, self.table(path, given), words)
            if role is Role.SENSOR_FAULT and "unit" not in fields:
                fields["unit"] = self._units(fields.get("of"))
            if role is Role.PARAM:
                fields.setdefault("constant", True)
            if "range" in fields:
                fields["limits"] = fields.pop("range")
            if "of" in words and "of" not in fields:
                self.fail(path, f"{role} {names} needs of = the name of what it adds to")
            self.tried(path, plant.declare, role, names, **fields)

    def _units(self, of: Any) -> Any:
        """Return the units of outputs that sensor faults add to."""
        names = [n for part in (of if isinstance(of, list) else [of]) for n in _expanded(part)]
        entries = [self.data.get("outputs", {}).get(name) for name in names]
        units = [e.get("unit", "") if isinstance(e, dict) else "" for e in entries]
        return units if units else ""

    def _equations(self, plant: Plant, symbols: Mapping[str, sp.Expr], delays: Delays) -> None:
        """State dynamics and outputs; what they delay are states behind the others."""
        for table in ("dynamics", "outputs"):
            if not self.data.get(table):
                self.fail((table,), f"the plant has no [{table}]")
        rows, states = self.data["dynamics"], plant.names("x")
        states = states[: len(states) - len(delays.rows)]
        for name in rows:
            if name not in states:
                self.fail(("dynamics", name), f"{name} is no state{_close(name, states)}")
        for name in states:
            if name not in rows:
                self.fail(("dynamics",), f"the state {name} has no equation in [dynamics]")
        found = [self.expression(("dynamics", name), rows[name], symbols) for name in states]
        names, texts, units, ranges = [], [], [], []
        for name, entry in self.data["outputs"].items():
            path = ("outputs", name)
            given = entry if isinstance(entry, dict) else {"is": entry}
            fields = self._fields(path, given, _OUTPUT)
            if "is" not in fields:
                self.fail(path, f'the output {name} needs is = "what it shows"')
            where = (*path, "is") if isinstance(entry, dict) else path
            texts.append(self.expression(where, fields["is"], symbols))
            names.append(name)
            units.append(fields.get("unit", ""))
            ranges.append(fields.get("range"))
        Ts = self.data.get("Ts")
        step = None if Ts is None else self._number(("Ts",), Ts)
        found += delays.rows
        self.tried(("Ts",) if Ts is not None else ("dynamics",), plant.dynamics, found, Ts=step)
        self.tried(("outputs",), plant.outputs, texts, names=names, unit=units, range=ranges)

    def _fields(self, path: Keys, entry: Mapping[str, Any], words: Collection[str]) -> Any:
        """Return the keywords of a declaration, their numbers read."""
        self.known(path, entry, words)
        return {
            word: value if word in _TEXTS else self._number((*path, word), value)
            for word, value in entry.items()
        }

    def _number(self, path: Keys, value: Any) -> Any:
        """Return numbers as given; text as the exact number it says."""
        if isinstance(value, list):
            return [self._number(path, item) for item in value]
        return self.expression(path, value, {}) if isinstance(value, str) else value

    def expression(self, path: Keys, text: Any, symbols: Mapping[str, Any]) -> sp.Expr:
        """Read an equation, or a number."""
        if isinstance(text, int | float) and not isinstance(text, bool):
            text = repr(text)
        if not isinstance(text, str):
            self.fail(path, f"an equation is text in quotes, not {text!r}")
        try:
            return read_text(text, symbols, self._more)
        except TextError as error:
            start = self.text.find(text, self._place(path)) if text else -1
            message = str(error).rsplit(", at position", 1)[0]
            if start < 0:
                self.fail(path, message)
            self._fail_at(start + error.position, message)

    def table(self, path: Keys, value: Any) -> Any:
        """Return a table, or refuse what is none."""
        if not isinstance(value, dict):
            such = "bound = 0.1" if path[0] == "disturbances" else "unit = 'cm'"
            self.fail(path, f"{path[-1]} is a table such as {{ {such} }}, not {value!r}")
        return value

    def known(self, path: Keys, given: Mapping[str, Any], words: Collection[str]) -> None:
        """Refuse keys that have no meaning."""
        for word in given:
            if word not in words:
                place = f"in {path[-1]}" if path else "here"
                self.fail((*path, word), f"{word} has no meaning {place}{_close(word, words)}")

    def tried(self, path: Keys, call: Any, *args: Any, **keywords: Any) -> Any:
        """Call something; what it refuses gets its place in the text."""
        try:
            return call(*args, **keywords)
        except ObsynthError as error:
            self.fail(path, str(error))

    # -- places ----------------------------------------------------------------------

    def _index(self) -> dict[Keys, int]:
        """Return where keys and headers of tables begin."""
        found: dict[Keys, int] = {}
        at, quoted = 0, False
        table: Keys = ()
        for line in self.text.split("\n"):
            if not quoted and (header := _HEADER.match(line)):
                table = tuple(part.strip(" \"'") for part in header[1].split("."))
                found.setdefault(table, at + line.index("["))
            elif not quoted and (key := _KEY.match(line)):
                parts = [key[1].strip("\"'")] if key[1][0] in "\"'" else key[1].split(".")
                found.setdefault((*table, *parts), at + key.start(1))
            quoted ^= (line.count('"""') + line.count("'''")) % 2 == 1
            at += len(line) + 1
        return found

    def _place(self, path: Keys) -> int:
        """Return where a key stands, or what it would stand in."""
        for n in range(len(path), 0, -1):
            if path[:n] in self._places:
                start = self._places[path[:n]]
                later = [p for p in self._places.values() if p > start]
                end = min(later, default=len(self.text))
                for part in path[n:]:
                    key = re.compile(rf"\b{re.escape(part)}\b\s*=").search(self.text, start, end)
                    start = start if key is None else key.start()
                return start
        return 0

    def fail(self, path: Keys, message: str) -> NoReturn:
        """Refuse what stands at a key."""
        self._fail_at(self._place(path), message)

    def _fail_at(self, place: int, message: str) -> NoReturn:
        place = min(place, len(self.text))
        line = self.text.count("\n", 0, place) + 1
        start = self.text.rfind("\n", 0, place) + 1
        shown = self.text[start:].split("\n", 1)[0]
        column = place - start + 1
        # a long line is shown around the place
        first = max(0, column - 60)
        pointer = " " * (column - 1 - first) + "^"
        raise PlantError(
            f"{self.where}, line {line}, column {column}: {message}\n"
            f"    {shown[first : first + 100]}\n    {pointer}",
            line=line,
            column=column,
        )


def _no_steps(signal: sp.Expr, steps: sp.Expr) -> sp.Expr:
    raise PlantError(
        f"delayed({signal}, {steps}) counts steps, and these equations are derivatives: write "
        "those of next values, with Ts = ... below the name and no [discretise]"
    )


def _close(name: str, known: Collection[str]) -> str:
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    return f"; did you mean {close[0]}?" if close else f"; known are {', '.join(sorted(known))}"


def _expanded(names: Any) -> tuple[str, ...]:
    try:
        return expand_names(names)
    except PlantError:
        return ()
