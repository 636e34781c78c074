"""The arithmetic of one step in the C that CasADi writes, without CasADi's interface."""

import re

import casadi as ca

from obsynth.codegen.errors import CodegenError
from obsynth.codegen.kernel import (
    DOUBLE,
    LIBRARY,
    RESULTS,
    STEP_INPUTS,
    Kernel,
    instructions,
    scalar_function,
)

# CasADi wraps these to serve C89 as well; the wrapped C99 function is what its VM calls.
_WRAPPED = frozenset({"expm1", "fabs", "fmax", "fmin", "hypot", "log1p"})

_FUNCTION = re.compile(
    r"^static int casadi_f0\([^)]*\) \{\n(?P<body>.*?)^\}\n", re.MULTILINE | re.DOTALL
)
_HELPER = re.compile(r"^casadi_real casadi_(\w+)\(([^)]*)\) (\{[^\n]*\})$", re.MULTILINE)
_READ = re.compile(r"arg\[(\d+)\]\? arg\[\1\]\[(\d+)\] : 0")
_WRITE = re.compile(r"if \(res\[(\d+)\]!=0\) res\[\1\]\[(\d+)\]=")
_LITERAL = re.compile(r"(?<![\w.])\d+\.\d*e[+-]\d+")
_WORD = re.compile(r"(?<![\d.])[A-Za-z_]\w*")  # "e+300" of a literal is no word


def _casadi_text(function: ca.Function) -> str:
    generator = ca.CodeGenerator("kernel", {"with_header": False})
    generator.add(function, False)
    return str(generator.dump())


def _surprise(what: str) -> CodegenError:
    version = ca.CasadiMeta.version()
    return CodegenError(
        f"{what}; this obsynth cannot use the C that CasADi {version} writes for this step",
        casadi=version,
    )


def _shortest(literal: re.Match[str]) -> str:
    return DOUBLE.number(float(literal[0]))


def generate_kernel(step: ca.Function, prefix: str) -> Kernel:
    """Write the arithmetic of a step as static C functions: CasADi's statements on plain arrays."""
    function = scalar_function(step)
    text = _casadi_text(function)
    found = _FUNCTION.findall(text)
    if len(found) != 1:
        raise _surprise(f"{len(found)} functions found in CasADi's C where one was expected")
    body = found[0]

    body = _READ.sub(lambda m: f"{STEP_INPUTS[int(m[1])]}[{m[2]}]", body)
    body = _WRITE.sub(lambda m: f"{RESULTS[int(m[1])]}[{m[2]}]=", body)
    body = _LITERAL.sub(_shortest, body)
    lines = body.rstrip().splitlines()
    if lines[-1].strip() != "return 0;":
        raise _surprise(f"CasADi's function ends on {lines[-1].strip()!r}")
    body = "\n".join(f"  {line}" for line in lines[:-1])

    helpers = {name: (arguments, code) for name, arguments, code in _HELPER.findall(text)}
    used: list[str] = []

    def rename(match: re.Match[str]) -> str:
        word = match[1]
        if word == "real":
            return f"{prefix}_real_t"
        if word in {"inf", "nan"}:
            return {"inf": "INFINITY", "nan": "NAN"}[word]
        if word in _WRAPPED:
            return word
        if word not in helpers:
            raise _surprise(f"CasADi's C uses casadi_{word}, which is not known")
        if word not in used:
            used.append(word)
        return f"{prefix}_{word}"

    body = re.sub(r"\bcasadi_(\w+)", rename, body)
    library = _check_words(body, prefix, used)
    parts = [
        re.sub(r"\bcasadi_(\w+)", rename, f"static casadi_real casadi_{name}({arguments}) {code}")
        for name in used
        for arguments, code in [helpers[name]]
    ]
    enclosed, arguments = _enclose(function, prefix, body)
    parts.append(enclosed)
    return Kernel(
        backend="casadi",
        functions="\n\n".join(parts),
        arguments=arguments,
        library=library,
        operations=int(function.n_instructions()),
        counts=instructions(function),
    )


def _check_words(body: str, prefix: str, helpers: list[str]) -> tuple[str, ...]:
    """Return the library functions of the body; refuse every word whose meaning is not known."""
    known = {*STEP_INPUTS, *RESULTS, "INFINITY", "NAN", f"{prefix}_real_t"}
    known |= {f"{prefix}_{helper}" for helper in helpers}
    library = set()
    for word in set(_WORD.findall(body)):
        if word in LIBRARY:
            library.add(word)
        elif word == "erfinv":
            raise CodegenError(
                "the step calls erfinv, which the mathematics library of C99 does not have",
                symbol="erfinv",
            )
        elif word not in known and not re.fullmatch(r"a\d+", word):
            raise _surprise(f"CasADi's C holds {word!r}, which is not known")
    return tuple(sorted(library))


def _enclose(function: ca.Function, prefix: str, body: str) -> tuple[str, tuple[str, ...]]:
    """Put the body into a function of plain arrays, without unused parameters."""
    real = f"{prefix}_real_t"
    words = set(_WORD.findall(body))
    arguments, parameters = [], []
    for i, name in enumerate(STEP_INPUTS[: function.n_in()]):
        if name in words:
            arguments.append(name)
            parameters.append(f"const {real} {name}[{function.numel_in(i)}]")
    for i, name in enumerate(RESULTS[: function.n_out()]):
        if name in words:
            arguments.append(name)
            parameters.append(f"{real} {name}[{function.numel_out(i)}]")
    head = ",\n    ".join(parameters)
    return f"static void {prefix}_kernel(\n    {head})\n{{\n{body}\n}}", tuple(arguments)
