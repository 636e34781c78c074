"""Names and comments that C and C++ take, made from the user's."""

import re
import unicodedata
from collections.abc import Iterable

from obsynth.codegen.errors import CodegenError

_KEYWORD_TEXT = """
    alignas alignof and and_eq asm auto bitand bitor bool break case catch char class compl concept
    const const_cast consteval constexpr constinit continue co_await co_return co_yield decltype
    default delete do double dynamic_cast else enum explicit export extern false float for friend
    goto if inline int long mutable namespace new noexcept not not_eq nullptr operator or or_eq
    private protected public register reinterpret_cast requires restrict return short signed sizeof
    static static_assert static_cast struct switch template this thread_local throw true try typedef
    typeid typename typeof union unsigned using virtual void volatile wchar_t while xor xor_eq
"""

# A project called "math" would put its own math.h before the compiler's; one called "test"
# would clash with the targets that CMake, CTest and make define themselves, one called "m" would
# be linked in place of the mathematics library.
_HEADER_TEXT = """
    assert complex ctype errno fenv float inttypes iso646 limits locale math setjmp signal stdarg
    stdbool stddef stdint stdio stdlib string tgmath time wchar wctype
"""
_TARGET_TEXT = """
    all all_build build clean continuous depend edit_cache example experimental help install
    install_local install_strip list_install_components nightly nightlymemorycheck none package
    package_source rebuild_cache run_tests test uninstall zero_check c dl gcc m pthread rt util
"""

_DEVICE = re.compile(r"aux|con|nul|prn|(com|lpt)\d", re.IGNORECASE)
_LONGEST = 200

_KEYWORDS = frozenset(_KEYWORD_TEXT.split())
_TAKEN = frozenset(f"{_HEADER_TEXT} {_TARGET_TEXT}".split())

_ASCII = str.maketrans(
    {
        "°": "deg ",
        "µ": "u",
        "μ": "u",
        "Ω": "Ohm",
        "²": "^2",
        "³": "^3",
        "·": "*",
        "×": "x",
        "±": "+-",
        "−": "-",
        "–": "-",
        "—": "-",
        "≤": "<=",
        "≥": ">=",
        "’": "'",
    }
)


def _letter(char: str) -> str:
    """Spell a letter outside ASCII by the last word of its Unicode name."""
    if char.isascii():
        return char
    decomposed = unicodedata.normalize("NFKD", char).encode("ascii", "ignore").decode()
    if decomposed:
        return decomposed
    if unicodedata.combining(char):
        return ""
    return unicodedata.name(char, "?").split()[-1].lower() if char.isalpha() else "?"


def _ascii(text: str) -> str:
    return "".join(map(_letter, text.translate(_ASCII)))


def identifier(text: str) -> str:
    r"""Return the C identifier closest to a name."""
    name = re.sub(r"[^A-Za-z0-9]+", "_", _ascii(text)).strip("_")
    if not name:
        raise CodegenError(
            f"{text!r} holds no letter or digit, so it cannot become a C name; rename it",
            symbol=text,
        )
    if name[0].isdigit():
        name = f"n{name}"
    return f"{name}_" if name in _KEYWORDS else name


def unique(names: Iterable[str]) -> tuple[str, ...]:
    """Return C identifiers for names, told apart by a number where they fall together."""
    taken: list[str] = []
    for text in names:
        base = name = identifier(text)
        count = 1
        while name in taken:
            count += 1
            name = f"{base.rstrip('_')}_{count}"
        taken.append(name)
    return tuple(taken)


def project_name(name: str | None, plant: str) -> str:
    """Return the project's name: checked when the user gave it, made from the plant's otherwise."""
    chosen = identifier(plant) if name is None else name
    advice = "give another one by name="
    if identifier(chosen) != chosen:
        raise CodegenError(
            f"name={chosen!r} is no name that every C and C++ compiler accepts; {advice},"
            f" for example name={identifier(chosen)!r}",
            symbol=chosen,
        )
    if chosen.lower() in _TAKEN:
        raise CodegenError(
            f"name={chosen!r} would hide a header, a library or a target of the build; {advice},"
            f" for example name={chosen + '_observer'!r}",
            symbol=chosen,
        )
    if _DEVICE.fullmatch(chosen) or len(chosen) > _LONGEST:
        raise CodegenError(
            f"name={chosen[:30]!r} ({len(chosen)} letters) is no name of a file under Windows or is"
            f" longer than {_LONGEST} letters; {advice}",
            symbol=chosen,
        )
    return chosen


def c_comment(text: str) -> str:
    """Return text that stays inside a C comment on one line, in ASCII."""
    plain = "".join(c if c.isprintable() else " " for c in _ascii(text))
    plain = re.sub(r"\?+", "?", plain.replace("\\", "/"))
    plain = plain.replace("*/", "* /").replace("/*", "/ *")
    return " ".join(plain.split())
