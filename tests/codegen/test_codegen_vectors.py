"""Which steps are recorded: healthy ones, every bit, both sides of every limit; what they catch."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import methods
import obsynth as ob
from obsynth.codegen import ComparisonError, build_and_compare, find_compiler, generate_c, tape
from obsynth.codegen.description import describe
from obsynth.codegen.kernel import DOUBLE, SINGLE
from obsynth.codegen.lanes import Lanes, differ
from obsynth.codegen.recording import Step
from obsynth.codegen.vectors import COUNT, record
from obsynth.designs.core.observer import STATUS

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))
from vector_score import Mutant, score

FINITE = 1e300


def window() -> ob.FaultDetector:
    return ob.FaultDetector(methods.observer_of("general_uio"), 2, window=5)


def made(name: str) -> Any:
    return window() if name == "window" else methods.observer_of(name)


def shares(observer: Any) -> None:
    """Half of the steps healthy, tens of every bit or none at all, less than a megabyte."""
    recorder, kinds = record(describe(observer, "p"))
    vectors = recorder.vectors(kinds)
    assert vectors.count == sum(kinds.values()) == COUNT
    assert len(vectors.text) < 1_000_000
    assert vectors.statuses[0] >= COUNT // 2
    for bit in STATUS.values():
        times = sum(n for status, n in vectors.statuses.items() if status & bit)
        assert times == 0 or times >= 20, bit


def test_most_steps_are_healthy_and_every_bit_has_its_share() -> None:
    """Mutant: stretches in any order, in place of the healthiest first."""
    shares(methods.observer_of("qpv_observer"))


@pytest.mark.long
@pytest.mark.parametrize("name", ["bounded_error_uio", "interval_observer", "window"])
def test_they_do_where_it_is_hard(name: str) -> None:
    shares(made(name))


@pytest.mark.parametrize("real", [DOUBLE, SINGLE], ids=["double", "single"])
def test_both_sides_of_every_limit_are_met(
    real: Any, make_toy: Callable[[], Any], make_single: Callable[[], Any]
) -> None:
    """Limits of the toy, told to nobody: readings and inputs that are finite, the flag, and the
    range of a state that is affine in them. Mutants: halving that ends two numbers apart; the lower
    of two neighbours left out."""
    toy = make_toy() if real is DOUBLE else make_single()
    recorder, _ = record(describe(toy, "p"), 1000)
    steps = recorder.steps
    finite = FINITE if real is DOUBLE else float(np.float32(1e30))
    for sign in (-1, 1):
        for i in range(3):
            seen = {float(step.inputs[i]) for step in steps}
            beyond = float(np.nextafter(real.type(sign * finite), real.type(sign * np.inf)))
            assert {sign * finite, beyond} <= seen
    flags = {float(step.before[1]) for step in steps}
    assert {0.5, float(np.nextafter(real.type(0.5), real.type(0)))} <= flags

    def one_apart(a: Step, b: Step) -> bool:
        one, other = (np.concatenate([s.before, s.inputs]) for s in (a, b))
        (places,) = np.nonzero(differ(one, other))
        if len(places) != 1:
            return False
        x, y = real.type(one[places[0]]), real.type(other[places[0]])
        return bool(np.nextafter(x, y) == y)

    groups = {bit: [s for s in steps if s.status == bit] for bit in (0, 4, 8)}
    for bit in (4, 8):
        assert any(one_apart(a, b) for a in groups[0] for b in groups[bit]), bit


def test_counters_are_met_below_at_and_above_their_limits() -> None:
    """Age and calls since a void one, of the guard; N is the horizon. Mutant: no whole numbers
    around limits of the memory."""
    observer = methods.observer_of("luenberger")
    place = observer.memory_layout["age"].start
    recorder, _ = record(describe(observer, "p"), 1000)
    ages = {float(step.before[place]) for step in recorder.steps}
    since = {float(s.before[observer.memory_layout["since"].start]) for s in recorder.steps}
    told = re.search(r"v \+ (\d+) calls", " ".join(observer.guarantee.claims))
    assert told is not None
    N = int(told[1]) / 2
    # one call on, the age is N and 2 N
    assert {0.0, 1.0, N - 2, N - 1, N, N + 1, 2 * N - 2, 2 * N - 1} <= ages
    assert {8.0, 9.0, 10.0} <= since


@pytest.mark.parametrize("name", ["luenberger", "hinf_uio"])
def test_lanes_are_what_the_machine_returns(name: str) -> None:
    """To the last bit, on what was recorded. Mutant: a branch of `choose` exchanged."""
    observer = made(name)
    description = describe(observer, "p")
    recorder, _ = record(description, 300)
    lanes = Lanes(observer.step, description.real)
    steps = recorder.steps
    inputs = np.array([s.inputs for s in steps]).T
    found = lanes.run([np.array([s.before for s in steps]).T, inputs[:1], inputs[1:]])
    told = {(port, i): k for port, i, k in lanes.results}
    for i in range(len(steps[0].after)):
        assert not differ(found[told[0, i]], np.array([s.after[i] for s in steps])).any()
    status = np.array([s.status for s in steps])
    assert (found[told[7, 0]] == status).all()


def test_the_toys_mutants_are_caught(make_toy: Callable[[], Any]) -> None:
    """Mutants of the vectors: no limits; no healthy stretches. Of the score: a change that is
    followed to no result."""
    found = score(make_toy(), 600, each=8)
    assert found.share >= 0.95, str(found)
    assert len(found.caught) >= 30
    assert f"{len(found.caught)} of " in str(found)


@pytest.mark.long
@pytest.mark.parametrize("name", [*methods.METHODS, "window"])
def test_95_of_100_mutants_are_caught_on_every_method(name: str) -> None:
    found = score(made(name), each=25)
    print(found)
    assert found.share >= 0.95, str(found)


def planted(mutant: Mutant) -> type[tape._Reader]:
    """What reads a tape with a mutant in it."""

    class Planted(tape._Reader):
        def used(self) -> list[tape._Value]:
            values = super().used()
            for value in self.values.values():
                value.uses, value.signed = 0, False
            name, operands = mutant.change
            changed = values[mutant.k]
            changed.name = name
            changed.args = tuple(
                values[p] if isinstance(p, int) else self.constant(p) for p in operands
            )
            changed.nan, changed.minus = tape._may_be(changed)
            return super().used()

    return Planted


@pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
@pytest.mark.parametrize(
    ("name", "tried"), [("toy", 1), pytest.param("luenberger", 6, marks=pytest.mark.long)]
)
def test_compiled_mutants_are_caught_as_evaluated_ones(
    name: str,
    tried: int,
    make_toy: Callable[[], Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of both kinds. Mutant: lanes that take another operation than the mutant says."""
    observer = make_toy() if name == "toy" else made(name)
    compiler = find_compiler()
    assert compiler is not None
    monkeypatch.setattr("obsynth.codegen.project.find_compiler", lambda: None)
    folder = generate_c(observer, tmp_path / "p", "p", backend="tape", vectors=600).folder
    path = folder / "src" / "p_kernel.h"
    place, text = describe(observer, "p").place, path.read_text()
    right = tape.write_tape(observer.step, "p", place)
    assert right.functions in text
    found = score(observer, 600, each=8)
    some = found.caught[:: -(-len(found.caught) // tried)]
    for mutant in (*some, *found.missed[:2], *found.equivalent[:2]):
        with monkeypatch.context() as patch:
            patch.setattr(tape, "_Reader", planted(mutant))
            wrong = tape.write_tape(observer.step, "p", place)
        path.write_text(text.replace(right.functions, wrong.functions))
        flags = ("-O0", "-w")
        if mutant in found.caught:
            with pytest.raises(ComparisonError):
                build_and_compare(folder, "p", compiler=compiler, extra_flags=flags)
        else:
            build_and_compare(folder, "p", compiler=compiler, extra_flags=flags)
