"""The law of one agent in plain Python: floats, lists and `math`."""

import json
import math
from collections.abc import Collection, Mapping

from echelon.simulation.onboard.law_functions import LawFunction
from echelon.simulation.onboard.statements import COMMON, Syntax, statements

# Python raises errors where C returns infinity or NaN.
_HELPERS = {
    "law_divide": """
def law_divide(a, b):
    return a / b if b != 0.0 else a * math.copysign(math.inf, b)
""",
    "law_sqrt": """
def law_sqrt(a):
    return math.sqrt(a) if a >= 0.0 else math.nan
""",
    "law_rint": """
def law_rint(a):
    size = abs(a)
    if not size < 4503599627370496.0:
        return a
    return math.copysign((size + 4503599627370496.0) - 4503599627370496.0, a)
""",
    "law_floor": """
def law_floor(a):
    nearest = law_rint(a)
    return nearest - 1.0 if nearest > a else nearest
""",
    "law_ceil": """
def law_ceil(a):
    return -law_floor(-a)
""",
    "law_min": """
def law_min(a, b):
    return a if a < b or a != a or (a == b and math.copysign(1.0, a) < 0.0) else b
""",
    "law_max": """
def law_max(a, b):
    return b if a < b or b != b or (a == b and math.copysign(1.0, a) < 0.0) else a
""",
    "law_pow2": """
def law_pow2(a):
    return math.ldexp(1.0, int(a)) if math.isfinite(a) else a
""",
    "law_split": """
def law_split(a):
    half, exponent = math.frexp(abs(a))
    return (2.0 * half, exponent - 1.0) if half < 0.7071067811865476 else (half, exponent + 0.0)
""",
    "law_exponent": """
def law_exponent(a):
    return law_split(a)[1]
""",
    "law_mantissa": """
def law_mantissa(a):
    return law_split(a)[0]
""",
    "law_root_guess": """
def law_root_guess(a):
    if not 2.3e-308 < a < math.inf:
        return 1.0
    half, exponent = math.frexp(a)
    bits = ((exponent + 1022) << 52) + int((half - 0.5) * 2.0**53)
    bits = 0x5FE6EB50C7B537A9 - (bits >> 1)
    return math.ldexp(1.0 + (bits & ((1 << 52) - 1)) * 2.0**-52, (bits >> 52) - 1023)
""",
    "law_bit": """
def law_bit(a, place):
    return math.isfinite(a) and (int(a) >> place) % 2 == 1
""",
    "law_single": """
def law_single(a):
    if not math.isfinite(a):
        return a
    half, exponent = math.frexp(a)
    digits = min(24, exponent + 149)
    size = math.ldexp(round(math.ldexp(abs(half), digits)), exponent - digits)
    return math.copysign(size if size < 2.0**128 else math.inf, a)
""",
}


def _literal(value: float | bool) -> str:
    """Return a plain number, to the bit."""
    if isinstance(value, bool) or math.isfinite(value):
        return repr(value)
    return "math.nan" if math.isnan(value) else f"{'-' * (value < 0.0)}math.inf"


_PYTHON = Syntax(
    {
        **COMMON,
        **dict.fromkeys(("div", "exact_div"), "law_divide({0}, {1})"),
        "abs": "abs({0})",
        "copysign": "math.copysign({0}, {1})",
        "and": "{0} and {1}",
        "or": "{0} or {1}",
        "not": "not {0}",
        "select": "{1} if {0} else {2}",
    },
    _literal,
    "{}",
    "    {word} = {name}[{place}]",
    "    {} = {}",
    "    {} = {}",
    _HELPERS,
)


def python_text(
    functions: Collection[LawFunction], about: str, constants: Mapping[str, float | str]
) -> str:
    """Return the functions as a module with constants by name; `about` is its docstring."""
    body = "\n\n".join(map(_function_text, functions))
    helpers = _PYTHON.used_helpers(body).replace("\n\n\n", "\n\n")
    named = "\n".join(f"{name} = {json.dumps(value)}" for name, value in constants.items())
    return f'"""{about}"""\n\nimport math\n\n{named}\n{helpers}\n\n{body}'


def _function_text(function: LawFunction) -> str:
    lines, words = statements(function, _PYTHON)
    head = f"def {function.name}({', '.join(function.inputs)}):"
    outputs = [f"[{', '.join(words[n] for n in part)}]" for part in function.outputs.values()]
    valid = [] if function.valid is None else [words[function.valid]]
    names = ", ".join([*function.outputs, *(["valid"] if valid else [])])
    return "\n".join(
        [
            head,
            f'    """Return {names}: {function.about}."""',
            *lines,
            f"    return {', '.join([*outputs, *valid])}",
            "",
        ]
    )
