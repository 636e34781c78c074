"""Which results of a step are numbers and in order, whatever bits it is given: proved of its tape.

Arithmetic may give a NaN anywhere. What is proved is that none comes out: on the way from there to
every result stands a comparison that a NaN fails, or an extreme that drops it. The tape tells what
is chosen where; comparisons that have to hold for a choice to be taken are its facts, and choices
whose test they do not decide are followed both ways. Nothing is assumed of sizes, rounding or the
precision, and nothing of memory and inputs.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from obsynth.codegen.kernel import RESULTS

_INF = float("inf")
_UNSIGNED = {"fabs", "neg", "sign", "floor", "ceil"}
_UNTOLD = {"next", "status", "mean_status"}
"""Results that are no signals: the next step trusts no memory, and statuses are sums of bits."""


@dataclass(eq=False)
class _Facts:
    """What holds in one case, possible unless it contradicts itself.

    known, waiting: tests by their identity, and those whose operands are not decided yet
    below: pairs of which the first is at most the second; numbers: what is none other
    """

    known: dict[int, bool] = field(default_factory=dict)
    waiting: list[tuple[Any, bool]] = field(default_factory=list)
    below: set[tuple[int, int]] = field(default_factory=set)
    numbers: set[int] = field(default_factory=set)
    possible: bool = True

    def told(self, test: Any) -> bool | None:
        """Return whether a test holds; None where that is not decided."""
        if id(test) in self.known:
            return self.known[id(test)]
        if test.name == "const":
            return bool(test.number != 0.0)
        if test.name == "not":
            inner = self.told(test.args[0])
            return inner if inner is None else not inner
        if test.name in {"and", "or"}:
            sides = {self.told(side) for side in test.args}
            strong: bool = test.name == "or"
            if strong in sides:
                return strong
            return None if None in sides else not strong
        return None

    def case(self, test: Any, holds: bool) -> "_Facts":
        """Return what holds besides where a test does, or does not."""
        found = _Facts(
            {**self.known}, [*self.waiting], {*self.below}, {*self.numbers}, self.possible
        )
        found.suppose(test, holds)
        return found

    def suppose(self, test: Any, holds: bool) -> None:
        """Add a test and what follows from it."""
        new = [(test, holds)]
        while new and self.possible:
            waiting, self.waiting = [*new, *self.waiting], []
            new = [pair for one in waiting for pair in self._follows(*one)]

    def _follows(self, test: Any, holds: bool) -> list[tuple[Any, bool]]:
        before, self.known[id(test)] = self.told(test), holds
        if before is not None and before is not holds:
            self.possible = False
        if test.name == "not":
            return [(test.args[0], not holds)]
        if test.name in {"lt", "le", "eq"} and holds:
            for side in test.args:
                self.numbers |= {id(inner) for inner in _unsigned(side)}
            one, other = map(id, test.args)
            self.below |= {(one, other), (other, one)} if test.name == "eq" else {(one, other)}
        if test.name not in {"and", "or"}:
            return []
        # all operands of a conjunction that holds do; one that fails has one at least that does
        if holds is (test.name == "and"):
            return [(side, holds) for side in test.args]
        sides = [self.told(side) for side in test.args]
        for side, other in ((0, 1), (1, 0)):
            if sides[side] is not holds and sides[side] is not None and sides[other] is None:
                return [(test.args[other], holds)]
        if sides == [None, None]:
            self.waiting.append((test, holds))
        return []

    def no_bit(self, word: Any) -> None:
        """Suppose that a sum of positive bits is zero."""
        if word.name in {"add", "twice"}:
            for term in word.args:
                self.no_bit(term)
        elif word.name == "if_else_zero" and word.args[1].name == "const":
            self.suppose(word.args[0], word.args[1].number <= 0.0)
        elif word.truth:
            self.suppose(word, False)

    def way(self, value: Any) -> list[Any]:
        """Return what a value is equal to: the branches that are taken, to the first undecided."""
        found = [value]
        while found[-1].name == "choose":
            holds = self.told(found[-1].args[0])
            if holds is None:
                break
            found.append(found[-1].args[1 if holds else 2])
        return found


def _unsigned(value: Any) -> list[Any]:
    """Return a value and those that it is the size, sign or whole part of."""
    found = [value]
    while found[-1].name in _UNSIGNED:
        found.append(found[-1].args[0])
    return found


def _number(facts: _Facts, value: Any) -> bool:
    """Whether a value is a number wherever the facts hold."""
    way = facts.way(value)
    if not facts.possible or any(not v.nan or id(v) in facts.numbers for v in way):
        return True
    value = way[-1]
    if value.name == "choose":
        test, then, otherwise = value.args
        cases = facts.case(test, True), facts.case(test, False)
        return _number(cases[0], then) and _number(cases[1], otherwise)
    if value.name == "if_else_zero":
        return _number(facts.case(value.args[0], True), value.args[1])
    if value.name in {"fmax", "fmin"}:
        return any(_number(facts, side) for side in value.args)
    return value.name in _UNSIGNED and _number(facts, value.args[0])


def _ordered(facts: _Facts, lower: Any, upper: Any, at: Mapping[int, int]) -> bool:
    """Whether two values are numbers and in order wherever the facts hold."""
    if lower is upper or not facts.possible:
        return _number(facts, lower)
    ways = facts.way(lower), facts.way(upper)
    if any((id(a), id(b)) in facts.below for a in ways[0] for b in ways[1]):
        return True
    low, high = (way[-1] for way in ways)
    if low.name == high.name == "const":
        return bool(low.number <= high.number)
    if low.name == "const" and low.number == -_INF:
        return _number(facts, upper)
    if high.name == "const" and high.number == _INF:
        return _number(facts, lower)
    choices = [value for value in (low, high) if value.name == "choose"]
    if not choices:
        return False
    test = max(choices, key=lambda value: at[id(value)]).args[0]
    return all(_ordered(facts.case(test, holds), lower, upper, at) for holds in (True, False))


@dataclass(frozen=True)
class Numbers:
    """Names of results, by what is proved over all bit patterns of memory and inputs.

    always: numbers at every status, ends of sets in order besides
    quiet: the same at status 0 alone
    unproved: neither
    """

    always: tuple[str, ...]
    quiet: tuple[str, ...]
    unproved: tuple[str, ...]


def prove_numbers(values: Sequence[Any], results: Sequence[tuple[int, int, Any]]) -> Numbers:
    """Prove which results of a step, read by `read_tape`, are numbers and in order."""
    at = {id(value): k for k, value in enumerate(values)}
    out = {(RESULTS[port], i): value for port, i, value in results}
    always, quiet = _Facts(), _Facts()
    quiet.no_bit(out["status", 0])
    found: dict[str, int] = {}
    for (name, i), value in out.items():
        if name in _UNTOLD:
            continue
        pair = value, value
        for end, other in (("_lower", "_upper"), ("_upper", "_lower")):
            if name.endswith(end):
                told = value, out[name.removesuffix(end) + other, i]
                pair = told if end == "_lower" else told[::-1]
        cases = [_ordered(facts, *pair, at) for facts in (always, quiet)]
        rank = 0 if cases[0] else 1 if cases[1] else 2
        found[name] = max(found.get(name, 0), rank)
    kinds = [tuple(name for name, rank in found.items() if rank == kind) for kind in range(3)]
    return Numbers(*kinds)
