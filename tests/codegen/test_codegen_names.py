"""Names, comments and numbers that every C and C++ compiler accepts."""

import math
import re
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from obsynth.codegen import CodegenError
from obsynth.codegen.kernel import DOUBLE, SINGLE
from obsynth.codegen.names import c_comment, identifier, project_name, unique
from obsynth.codegen.recording import Word, tokens

C_NAME = re.compile(r"[A-Za-z][A-Za-z0-9]*(_[A-Za-z0-9]+)*_?")


@settings(derandomize=True, deadline=None, max_examples=200)
@given(st.text(max_size=20))
def test_an_identifier_is_a_c_name_or_refused(text: str) -> None:
    try:
        name = identifier(text)
    except CodegenError:
        name = ""
    # Letters of other alphabets have names that are spelled out; digits of others have not.
    assert name or not re.search("[A-Za-z0-9]", text)
    assert not name or C_NAME.fullmatch(name)
    assert not name or identifier(name) == name


def test_a_name_without_letters_is_refused() -> None:
    with pytest.raises(CodegenError, match="rename") as caught:
        identifier("-+-")
    assert caught.value.symbol == "-+-"


@settings(derandomize=True, deadline=None, max_examples=300)
@given(st.text(alphabet="*/\\?\n x°µ", max_size=12))
def test_a_comment_cannot_be_left(text: str) -> None:
    comment = c_comment(text)
    assert not re.search(r"\*/|/\*|\\|\?\?|\n", comment)
    assert comment.isascii()


@pytest.mark.parametrize("text", ["*\\", "???", "**//", "/*/", "*\x00/", "????/"])
def test_comments_that_simple_replacement_lets_through(text: str) -> None:
    comment = c_comment(text)
    assert not re.search(r"\*/|/\*|\\|\?\?", comment)


def test_names_that_fall_together_are_told_apart() -> None:
    names = unique(["h_1", "h{1}", "h 1", "int", "int_"])
    assert len(set(names)) == 5
    assert names[0] == "h_1"


@pytest.mark.parametrize(
    ("name", "word"),
    [
        ("math", "hide"),
        ("Test", "hide"),
        ("double", "double_"),
        ("two tanks", "two_tanks"),
        ("9lives", "n9lives"),
        ("_tank", "'tank'"),
        ("a__b", "a_b"),
        ("", "no letter"),
    ],
)
def test_a_project_name_that_would_break_the_build_is_refused(name: str, word: str) -> None:
    with pytest.raises(CodegenError, match=word):
        project_name(name, "plant")


@settings(derandomize=True, deadline=None, max_examples=300)
@given(st.floats())
def test_bits_and_literals_are_read_back_exactly(value: float) -> None:
    (pattern,) = Word(DOUBLE).patterns([value]).tolist()
    assert tokens([pattern] * 3, [pattern, pattern, pattern ^ 1], Word(DOUBLE))[0] == ".2"
    *_, text = tokens([pattern] * 3, [pattern, pattern, pattern ^ 1], Word(DOUBLE))
    (back,) = struct.unpack(">d", bytes.fromhex(text.ljust(16, "0")))
    (half,) = Word(SINGLE).patterns([value]).tolist()
    (single,) = struct.unpack(">f", half.to_bytes(4, "big"))
    with np.errstate(over="ignore"):
        assert struct.pack(">f", single) == struct.pack(">f", np.float32(value)) or value != value
    literal = DOUBLE.number(value)
    if math.isnan(value):
        assert math.isnan(back)
        assert literal == "NAN"
        return
    assert struct.pack(">d", back) == struct.pack(">d", value)
    read = float(literal.replace("INFINITY", "inf"))
    assert struct.pack(">d", read) == struct.pack(">d", value)
    assert re.search(r"[.eI]", literal), "a literal of C's type double, not int"
