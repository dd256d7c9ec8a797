"""The law of one agent in single precision as text for LLVM, which makes machine code of it."""

import math
import struct
from collections.abc import Collection
from string import Template

import numpy as np

from echelon.simulation.codegen import is_installed, object_code
from echelon.simulation.onboard.law_functions import LawFunction
from echelon.simulation.onboard.statements import Syntax, statements

# With all four parts: of three LLVM takes the last one for the system, and passes numbers in
# registers of the processor, where callers do not look for them.
_PROCESSOR = ("thumbv7em-none-unknown-eabihf", "cortex-m4")
_UNARY = {"abs": "fabs", "sqrt": "sqrt"}
_OWN = ("floor", "ceil", "rint", "pow2", "exponent", "mantissa", "root_guess")
_FUSED = ("fma", "fms", "fnma")

# What a Cortex-M4F has no instruction for, so that no library is called.
_HELPERS = {
    "law_rint": """
  %size = call float @llvm.fabs.f32(float %a)
  %small = fcmp olt float %size, $whole
  %up = fadd float %size, $whole
  %down = fsub float %up, $whole
  %signed = call float @llvm.copysign.f32(float %down, float %a)
  %r = select i1 %small, float %signed, float %a
  ret float %r
""",
    "law_floor": """
  %near = call float @law_rint(float %a)
  %above = fcmp ogt float %near, %a
  %less = fsub float %near, 1.0
  %r = select i1 %above, float %less, float %near
  ret float %r
""",
    "law_ceil": """
  %n = fneg float %a
  %f = call float @law_floor(float %n)
  %r = fneg float %f
  ret float %r
""",
    "law_min": """
  %first = fcmp olt float %a, %b
  %none = fcmp uno float %a, %b
  %sum = fadd float %a, %b
  %other = select i1 %none, float %sum, float %b
  %r = select i1 %first, float %a, float %other
  ret float %r
""",
    "law_max": """
  %first = fcmp ogt float %a, %b
  %none = fcmp uno float %a, %b
  %sum = fadd float %a, %b
  %other = select i1 %none, float %sum, float %b
  %r = select i1 %first, float %a, float %other
  ret float %r
""",
    "law_fma": """
  %p = fmul float %a, %b
  %r = fadd float %p, %c
  ret float %r
""",
    "law_fms": """
  %p = fmul float %a, %b
  %r = fsub float %p, %c
  ret float %r
""",
    "law_fnma": """
  %p = fmul float %a, %b
  %r = fsub float %c, %p
  ret float %r
""",
    "law_pow2": """
  %moved = fadd float %a, $biased
  %bits = bitcast float %moved to i32
  %shifted = shl i32 %bits, 23
  %r = bitcast i32 %shifted to float
  ret float %r
""",
    "law_exponent": """
  %bits = bitcast float %a to i32
  %away = sub i32 %bits, $half_root
  %e = ashr i32 %away, 23
  %r = sitofp i32 %e to float
  ret float %r
""",
    "law_mantissa": """
  %bits = bitcast float %a to i32
  %away = sub i32 %bits, $half_root
  %e = ashr i32 %away, 23
  %back = shl i32 %e, 23
  %m = sub i32 %bits, %back
  %r = bitcast i32 %m to float
  ret float %r
""",
    "law_root_guess": """
  %bits = bitcast float %a to i32
  %half = lshr i32 %bits, 1
  %guess = sub i32 $guess, %half
  %r = bitcast i32 %guess to float
  ret float %r
""",
    "law_bit": """
  %bits = bitcast float %a to i32
  %shifted = lshr i32 %bits, %place
  %r = trunc i32 %shifted to i1
  ret i1 %r
""",
}


def _literal(value: float | bool) -> str:
    """Return a plain number, to the bit."""
    if isinstance(value, bool):
        return "true" if value else "false"
    # LLVM writes numbers of single precision with the bits of double precision.
    single = float(np.float32(value))
    return f"0x{struct.unpack('Q', struct.pack('d', single))[0]:016X}"


_NUMBERS = {
    "whole": _literal(2.0**23),
    "biased": _literal(1.5 * 2.0**23 + 127.0),
    "half_root": str(struct.unpack("i", struct.pack("f", math.sqrt(0.5)))[0]),
    "guess": str(0x5F375A86),
}


def _called(name: str, kind: str = "float") -> str:
    """Return a definition of a helper as text, which LLVM puts where it is called."""
    arguments = {"law_bit": "float %a, i32 %place"}
    places = "abc"[: 3 if name[4:] in _FUSED else 2 if name in ("law_min", "law_max") else 1]
    plain = ", ".join(f"float %{a}" for a in places)
    body = Template(_HELPERS[name]).substitute(_NUMBERS)
    return f"define internal {kind} @{name}({arguments.get(name, plain)}) alwaysinline {{{body}}}\n"


_LLVM = Syntax(
    {
        **{name: f"f{name} float {{0}}, {{1}}" for name in ("add", "sub", "mul", "div")},
        "unfused_sub": "fsub float {0}, {1}",
        "exact_div": "fdiv float {0}, {1}",
        "neg": "fneg float {0}",
        **{name: f"call float @llvm.{f}.f32(float {{0}})" for name, f in _UNARY.items()},
        "copysign": "call float @llvm.copysign.f32(float {0}, float {1})",
        **{name: f"call float @law_{name}(float {{0}})" for name in _OWN},
        **{x: f"call float @law_{x}(float {{0}}, float {{1}})" for x in ("min", "max")},
        **{x: f"call float @law_{x}(float {{0}}, float {{1}}, float {{2}})" for x in _FUSED},
        **{f"bit{k}": f"call i1 @law_bit(float {{0}}, i32 {k})" for k in (0, 1)},
        "lt": "fcmp olt float {0}, {1}",
        "le": "fcmp ole float {0}, {1}",
        "eq": "fcmp oeq float {0}, {1}",
        "ne": "fcmp une float {0}, {1}",
        **{name: f"{name} i1 {{0}}, {{1}}" for name in ("and", "or", "xor")},
        "not": "xor i1 {0}, true",
        "unlikely": "or i1 {0}, false",
        "single": "fsub float {0}, 0.0",
        "select": "select i1 {0}, {kind} {1}, {kind} {2}",
    },
    _literal,
    "%{}",
    "  {word}p = getelementptr float, ptr %{name}, i32 {place}\n"
    "  {word} = load float, ptr {word}p, align 4",
    "  {} = {}",
    "  {} = {}",
    ("float", "i1"),
    {name: _called(name, "i1" if name == "law_bit" else "float") for name in _HELPERS},
    deep=False,
)


def object_file(functions: Collection[LawFunction]) -> bytes | None:
    """Return functions as machine code of a Cortex-M4F; None where llvmlite is not installed."""
    return object_code(llvm_text(functions), *_PROCESSOR) if is_installed() else None


def llvm_text(functions: Collection[LawFunction]) -> str:
    """Return functions of single precision as text for LLVM, with the interface of `law.h`."""
    body = "\n".join(map(_function_text, functions))
    declared = (f"declare float @llvm.{name}.f32(float)" for name in _UNARY.values())
    copysign = "declare float @llvm.copysign.f32(float, float)"
    return "\n".join([*declared, copysign, _LLVM.used_helpers(body), body])


def _function_text(function: LawFunction) -> str:
    lines, words = statements(function, _LLVM)
    inputs = {
        name: f"float %{name}" if size is None else f"ptr %{name}"
        for name, size in function.inputs.items()
    }
    arguments = inputs | {name: f"ptr %{name}" for name in function.outputs}
    stores = [
        f"  %{name}{k}to = getelementptr float, ptr %{name}, i32 {k}\n"
        f"  store float {words[node]}, ptr %{name}{k}to, align 4"
        for name, part in function.outputs.items()
        for k, node in enumerate(part)
    ]
    head = f"@law_{function.name}({', '.join(arguments.values())}) nounwind"
    if function.valid is None:
        return "\n".join([f"define void {head} {{", *lines, *stores, "  ret void\n}\n"])
    branch = f"  br i1 {words[function.valid]}, label %accurate, label %not\naccurate:"
    ends = ["  ret i32 1", "not:", "  ret i32 0\n}\n"]
    return "\n".join([f"define i32 {head} {{", *lines, branch, *stores, *ends])
