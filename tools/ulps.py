"""Errors of the functions in single precision, over every float: minutes for all of them.

python tools/ulps.py                # every float, every function of one variable
python tools/ulps.py sin exp --step 101
"""

import argparse
import ctypes
import subprocess
import tempfile
from pathlib import Path

from obsynth.codegen.functions import ULPS, own_function
from obsynth.codegen.kernel import SINGLE
from obsynth.codegen.tape import write_function

MAIN = """#include <math.h>
#include <stdint.h>
#include <string.h>
typedef float p_real_t;
{text}
double worst(uint32_t first, uint32_t step, uint64_t count, uint32_t *where);
double worst(uint32_t first, uint32_t step, uint64_t count, uint32_t *where)
{{
    double most = 0.0;
    for (uint64_t i = 0; i < count; ++i) {{
        const uint32_t bits = first + (uint32_t)i * step;
        float x, y = 0.0f, got, near;
        memcpy(&x, &bits, 4);
        if (!({inside})) continue;
        {second}
        const double exact = {exact};
        got = {own};
        near = (float)exact;
        double error = 0.0;
        if (isnan(near) || isinf(near) || isnan(got) || isinf(got)) {{
            if (!(isnan(near) && isnan(got)) && !(near == got)) error = 1e9;
            /* the largest float and infinity are a unit apart */
            if (isinf(near) != isinf(got) && !isnan(got) && !isnan(near)
                && fabs(exact) < 3.4028237e38 && fabs(exact) > 3.402823e38) error = 1.0;
        }} else {{
            int e;
            frexp(exact, &e);
            error = fabs((double)got - exact) / ldexp(1.0, (e < -125 ? -125 : e) - 24);
        }}
        if (error > most) {{ most = error; *where = bits; }}
    }}
    return most;
}}
"""

# not far from the first argument; results over the whole range
SECOND = (
    "x * (float)ldexp(1.0 + r, (int)(bits % 25u) - 12)",
    "(float)(90.0 * (2.0 * r - 1.0) / log(fabs((double)x)))",
)


def measure(name: str, step: int, folder: Path) -> tuple[float, int]:
    """Return the largest error of a function in units in the last place, and bits of where."""
    two = own_function(name).n_in() == 2
    text, _ = write_function(name, "p", SINGLE)
    exact = f"{name}((double)x, (double)y)" if two else f"{name}((double)x)"
    own = f"p_{name}(x, y)" if two else f"p_{name}(x)"
    inside = "fabsf(x) <= 6433.0f" if name in {"sin", "cos", "tan"} else "1"
    second = "(void)y;"
    if two:
        second = (
            f"const double r = (bits * 2654435761u) / 4294967296.0; y = {SECOND[name == 'pow']};"
        )
    source = MAIN.format(text=text, second=second, exact=exact, own=own, inside=inside)
    (folder / "u.c").write_text(source)
    library = folder / f"{name}.so"
    flags = ("-O2", "-ffp-contract=off", "-shared", "-fPIC", "-o", str(library))
    subprocess.run(["gcc", *flags, str(folder / "u.c"), "-lm"], check=True)
    worst = ctypes.CDLL(str(library)).worst
    worst.restype = ctypes.c_double
    worst.argtypes = [ctypes.c_uint32, ctypes.c_uint32, ctypes.c_uint64, ctypes.c_void_p]
    where = ctypes.c_uint32()
    return worst(0, step, 2**32 // step, ctypes.addressof(where)), where.value


def main() -> None:
    """Print the largest error of every function that is named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=[*ULPS])
    parser.add_argument("--step", type=int, default=1)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for name in given.names:
            error, where = measure(name, given.step, Path(folder))
            print(f"{name:6} {error:8.4f} of {ULPS[name]} units, at {where:08x}", flush=True)


if __name__ == "__main__":
    main()
