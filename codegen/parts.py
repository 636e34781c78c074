"""Long kernels in several functions: compilers take more than linear time for one."""

import re
from collections.abc import Sequence

_LONG = 1500
_PART = 500
_NAME = re.compile(r"\bt\d+\b")
_DEFINED = re.compile(r"const (?P<kind>\w+) (?P<name>t\d+) = ")


def in_parts(
    loads: Sequence[str], lines: Sequence[str], stores: Sequence[str], prefix: str
) -> tuple[list[str], list[str]]:
    """Return static functions, and the body that calls them, for statements of a kernel.

    Of ``t0, t1, ...`` those of use beyond their part go by way of two arrays, whose places are
    taken again.
    """
    if len(lines) <= _LONG:
        return [], [*loads, *lines, "", *stores]
    real = f"{prefix}_real_t"
    parts = [loads, *(lines[i : i + _PART] for i in range(0, len(lines), _PART)), stores]
    born: dict[str, int] = {}
    kind: dict[str, str] = {}
    read: list[dict[str, None]] = []
    for k, part in enumerate(parts):
        for found in filter(None, map(_DEFINED.match, part)):
            born[found["name"]], kind[found["name"]] = k, found["kind"]
        read.append(dict.fromkeys(name for line in part for name in _NAME.findall(line)))
    last = {name: k for k, names in enumerate(read) for name in names}
    free: dict[str, list[int]] = {real: [], "_Bool": []}
    size = {real: 0, "_Bool": 0}
    place: dict[str, str] = {}
    texts: list[list[str]] = []
    for k, part in enumerate(parts):
        before = [name for name in read[k] if born[name] < k]
        # loads and stores stand in one function
        needed = [name for name in before if born[name] or k < len(parts) - 1]
        taken = [f"const {kind[name]} {name} = {place[name]};" for name in needed]
        for name in before:
            if last[name] == k:
                free[kind[name]].append(int(place[name].split("[")[1][:-1]))
        kept = []
        for name in read[k]:
            if born[name] == k < last[name]:
                of = kind[name]
                if not free[of]:
                    free[of].append(size[of])
                    size[of] += 1
                place[name] = f"{'w' if of == real else 'b'}[{free[of].pop()}]"
                kept.append(f"{place[name]} = {name};")
        texts.append([*taken, *part, *kept])
    arrays = f"{real} w[{max(size[real], 1)}]", f"_Bool b[{max(size['_Bool'], 1)}]"
    functions, calls = [], []
    for k, text in enumerate(texts[1:-1]):
        unused = [f"(void){a};" for a in "wb" if not any(f"{a}[" in line for line in text)]
        body = "\n".join(f"    {line}" for line in [*unused, *text])
        head = f"static void {prefix}_part_{k}({', '.join(arrays)})"
        functions.append(f"{head}\n{{\n{body}\n}}")
        calls.append(f"{prefix}_part_{k}(w, b);")
    return functions, [*(f"{array};" for array in arrays), "", *texts[0], *calls, *texts[-1]]
