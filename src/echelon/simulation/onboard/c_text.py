"""The law of one agent in C99: no memory is allocated, and of the library only `sqrt` is called."""

import json
from collections.abc import Mapping, Sequence

from echelon.simulation.onboard.law_functions import LawFunction
from echelon.simulation.onboard.statements import COMMON, Syntax, statements

# The same instructions on the bits of numbers as those of `codegen.vector_ir`.
_HELPERS = {
    "law_bits": """
static uint64_t law_bits(double a)
{
    union { double number; uint64_t bits; } word;
    word.number = a;
    return word.bits;
}
""",
    "law_number": """
static double law_number(uint64_t bits)
{
    union { double number; uint64_t bits; } word;
    word.bits = bits;
    return word.number;
}
""",
    "law_abs": """
static double law_abs(double a)
{
    return law_number(law_bits(a) & 0x7FFFFFFFFFFFFFFFULL);
}
""",
    "law_copysign": """
static double law_copysign(double a, double b)
{
    const uint64_t size = law_bits(a) & 0x7FFFFFFFFFFFFFFFULL;
    return law_number(size | (law_bits(b) & 0x8000000000000000ULL));
}
""",
    "law_rint": """
static double law_rint(double a)
{
    const double size = law_abs(a);
    if (!(size < 4503599627370496.0))
        return a;
    return law_copysign((size + 4503599627370496.0) - 4503599627370496.0, a);
}
""",
    "law_floor": """
static double law_floor(double a)
{
    const double nearest = law_rint(a);
    return nearest > a ? nearest - 1.0 : nearest;
}
""",
    "law_ceil": """
static double law_ceil(double a)
{
    return -law_floor(-a);
}
""",
    "law_min": """
static double law_min(double a, double b)
{
    return a < b || a != a || (a == b && law_copysign(1.0, a) < 0.0) ? a : b;
}
""",
    "law_max": """
static double law_max(double a, double b)
{
    return a < b || b != b || (a == b && law_copysign(1.0, a) < 0.0) ? b : a;
}
""",
    "law_pow2": """
static double law_pow2(double a)
{
    return law_number(law_bits(a + 6755399441056767.0) << 52);
}
""",
    "law_split": """
static int64_t law_split(double a)
{
    const int64_t away = (int64_t)(law_bits(a) - 0x3FE6A09E667F3BCDULL);
    return away >= 0 ? away >> 52 : -1 - ((-1 - away) >> 52);
}
""",
    "law_exponent": """
static double law_exponent(double a)
{
    return (double)law_split(a);
}
""",
    "law_mantissa": """
static double law_mantissa(double a)
{
    return law_number(law_bits(a) - ((uint64_t)law_split(a) << 52));
}
""",
    "law_root_guess": """
static double law_root_guess(double a)
{
    return law_number(0x5FE6EB50C7B537A9ULL - (law_bits(a) >> 1));
}
""",
    "law_bit": """
static int law_bit(double a, int place)
{
    return (int)((law_bits(a) >> place) & 1ULL);
}
""",
    "law_single": """
static double law_single(double a)
{
    return (double)(float)a;
}
""",
}

_C = Syntax(
    {
        **COMMON,
        "sqrt": "sqrt({0})",
        "and": "{0} && {1}",
        "or": "{0} || {1}",
        "not": "!{0}",
        "select": "{0} ? {1} : {2}",
    },
    "    const double {} = {};",
    "    const int {} = {};",
    ("(double)INFINITY", "(double)NAN", "1", "0"),
    _HELPERS,
)


def c_text(functions: Sequence[LawFunction], about: str) -> str:
    """Return the functions as a file of C; `about` is a comment at its head."""
    body = "\n".join(map(_function_text, functions))
    helpers = _C.used_helpers(body).replace("\n\n\n", "\n\n")
    includes = '#include <math.h>\n#include <stdint.h>\n\n#include "law.h"\n'
    return f"/* {about} */\n\n{includes}{helpers}\n{body}"


def header_text(
    functions: Sequence[LawFunction], about: str, constants: Mapping[str, float | str]
) -> str:
    """Return the declarations of the functions, and constants by name."""
    return "\n".join(
        [
            f"/* {about} */",
            "",
            "#ifndef LAW_H",
            "#define LAW_H",
            "",
            *(f"#define LAW_{name} {json.dumps(value)}" for name, value in constants.items()),
            "",
            *(f"/* {f.about[0].upper()}{f.about[1:]}. */\n{_head(f)};\n" for f in functions),
            "#endif",
            "",
        ]
    )


def _head(function: LawFunction) -> str:
    # Memory is replaced where it is both an input and an output.
    inputs = {
        name: f"double {name}" if size is None else f"const double *{name}"
        for name, size in function.inputs.items()
    }
    arguments = {**inputs, **{name: f"double *{name}" for name in function.outputs}}
    kind = "void" if function.valid is None else "int"
    return f"{kind} law_{function.name}({', '.join(arguments.values())})"


def _function_text(function: LawFunction) -> str:
    lines, words = statements(function, _C)
    read = {node.value[0] for node in words if node.op == "leaf"}
    unread = [name for name in function.inputs if name not in read]
    valid = None if function.valid is None else words[function.valid]
    return "\n".join(
        [
            _head(function),
            "{",
            *(f"    (void){name};" for name in unread if function.outputs.get(name) is None),
            *(f"    (void){name};" for name, part in function.outputs.items() if not part),
            *lines,
            *([] if valid is None else [f"    if (!{valid})", "        return 0;"]),
            *(
                f"    {name}[{k}] = {words[node]};"
                for name, part in function.outputs.items()
                for k, node in enumerate(part)
            ),
            *([] if valid is None else ["    return 1;"]),
            "}",
            "",
        ]
    )
