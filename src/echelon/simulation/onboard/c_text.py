"""The law of one agent in C99: no memory is allocated, and of the library only `sqrt` is called."""

import json
import math
from collections.abc import Collection, Mapping
from string import Template

import numpy as np

from echelon.simulation.onboard.law_functions import LawFunction
from echelon.simulation.onboard.statements import COMMON, Syntax, statements

_HELPERS = {
    "law_bits": """
static $bits law_bits(law_real a)
{
    union { law_real number; $bits bits; } word;
    word.number = a;
    return word.bits;
}
""",
    "law_number": """
static law_real law_number($bits bits)
{
    union { law_real number; $bits bits; } word;
    word.bits = bits;
    return word.number;
}
""",
    "law_abs": """
static law_real law_abs(law_real a)
{
    return law_number(law_bits(a) & $size);
}
""",
    "law_copysign": """
static law_real law_copysign(law_real a, law_real b)
{
    return law_number((law_bits(a) & $size) | (law_bits(b) & ~$size));
}
""",
    "law_rint": """
static law_real law_rint(law_real a)
{
    const law_real size = law_abs(a);
    if (!(size < $whole))
        return a;
    return law_copysign((size + $whole) - $whole, a);
}
""",
    "law_floor": """
static law_real law_floor(law_real a)
{
    const law_real nearest = law_rint(a);
    return nearest > a ? nearest - 1 : nearest;
}
""",
    "law_ceil": """
static law_real law_ceil(law_real a)
{
    return -law_floor(-a);
}
""",
    "law_min": """
static law_real law_min(law_real a, law_real b)
{
    return a < b || a != a || (a == b && law_copysign(1, a) < 0) ? a : b;
}
""",
    "law_max": """
static law_real law_max(law_real a, law_real b)
{
    return a < b || b != b || (a == b && law_copysign(1, a) < 0) ? b : a;
}
""",
    "law_pow2": """
static law_real law_pow2(law_real a)
{
    return law_number(law_bits(a + $biased) << $digits);
}
""",
    "law_split": """
static $signed law_split(law_real a)
{
    const $signed away = ($signed)(law_bits(a) - $half_root);
    return away >= 0 ? away >> $digits : -1 - ((-1 - away) >> $digits);
}
""",
    "law_exponent": """
static law_real law_exponent(law_real a)
{
    return (law_real)law_split(a);
}
""",
    "law_mantissa": """
static law_real law_mantissa(law_real a)
{
    return law_number(law_bits(a) - (($bits)law_split(a) << $digits));
}
""",
    "law_root_guess": """
static law_real law_root_guess(law_real a)
{
    return law_number($guess - (law_bits(a) >> 1));
}
""",
    "law_bit": """
static int law_bit(law_real a, int place)
{
    return (int)((law_bits(a) >> place) & 1U);
}
""",
    "law_single": """
static law_real law_single(law_real a)
{
    return (law_real)(float)a;
}
""",
}

# The same instructions on the bits of numbers as those of `codegen.vector_ir`.
_WORDS = {
    64: {
        "bits": "uint64_t",
        "signed": "int64_t",
        "size": "0x7FFFFFFFFFFFFFFFULL",
        "whole": "4503599627370496.0",
        "biased": "6755399441056767.0",
        "digits": "52",
        "half_root": "0x3FE6A09E667F3BCDULL",
        "guess": "0x5FE6EB50C7B537A9ULL",
    },
    32: {
        "bits": "uint32_t",
        "signed": "int32_t",
        "size": "0x7FFFFFFFU",
        "whole": "8388608.0f",
        "biased": "12583039.0f",
        "digits": "23",
        "half_root": "0x3F3504F3U",
        "guess": "0x5F375A86U",
    },
}


def _literal(bits: int, value: float | bool) -> str:
    """Return a plain number; a literal without `f` would make single precision double."""
    if isinstance(value, bool):
        return str(int(value))
    if math.isfinite(value):
        return repr(value) if bits == 64 else f"{np.float32(value)!s}f"
    return "(law_real)NAN" if math.isnan(value) else f"{'-' * (value < 0.0)}(law_real)INFINITY"


def _syntax(bits: int) -> Syntax:
    words = _WORDS[bits]
    return Syntax(
        {
            **COMMON,
            "sqrt": "sqrt({0})" if bits == 64 else "sqrtf({0})",
            "and": "{0} && {1}",
            "or": "{0} || {1}",
            "not": "!{0}",
            "select": "{0} ? {1} : {2}",
        },
        lambda value: _literal(bits, value),
        "{}",
        "    const law_real {word} = {name}[{place}];",
        "    const law_real {} = {};",
        "    const int {} = {};",
        {name: Template(text).substitute(words) for name, text in _HELPERS.items()},
    )


def c_text(double: Collection[LawFunction], single: Collection[LawFunction], about: str) -> str:
    """Return functions as a file of C, in single precision where `LAW_SINGLE` is defined.

    `about` is a comment at its head.
    """
    parts = [
        f"/* {about} */",
        "",
        "#include <math.h>",
        "#include <stdint.h>",
        "",
        '#include "law.h"',
        "",
        "#ifdef LAW_SINGLE",
        _functions_text(single, 32),
        "#else",
        _functions_text(double, 64),
        "#endif",
        "",
    ]
    return "\n".join(parts)


def _functions_text(functions: Collection[LawFunction], bits: int) -> str:
    syntax = _syntax(bits)
    body = "\n".join(_function_text(function, syntax) for function in functions)
    return f"{syntax.used_helpers(body)}\n{body}".replace("\n\n\n", "\n\n")


def header_text(
    functions: Collection[LawFunction], about: str, constants: Mapping[str, float | str]
) -> str:
    """Return the declarations of the functions, and constants by name."""
    return "\n".join(
        [
            f"/* {about} */",
            "",
            "#ifndef LAW_H",
            "#define LAW_H",
            "",
            "#ifdef LAW_SINGLE",
            "typedef float law_real;",
            "#else",
            "typedef double law_real;",
            "#endif",
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
        name: f"law_real {name}" if size is None else f"const law_real *{name}"
        for name, size in function.inputs.items()
    }
    arguments = {**inputs, **{name: f"law_real *{name}" for name in function.outputs}}
    kind = "void" if function.valid is None else "int"
    return f"{kind} law_{function.name}({', '.join(arguments.values())})"


def _function_text(function: LawFunction, syntax: Syntax) -> str:
    lines, words = statements(function, syntax)
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
