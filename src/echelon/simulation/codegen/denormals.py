"""How a kernel treats denormal numbers: as 0, in operands and in results, as JAX does.

An operation with one takes a hundred times as long. Each thread sets the bits of its processor's
register that say so when it enters a kernel, and puts them back when it leaves.
"""

import platform

_X86 = """\
declare void @llvm.x86.sse.stmxcsr(ptr)
declare void @llvm.x86.sse.ldmxcsr(ptr)
define void @run(ptr noalias %slots) nounwind {
  %old = alloca i32
  %new = alloca i32
  call void @llvm.x86.sse.stmxcsr(ptr %old)
  %before = load i32, ptr %old
  %within = or i32 %before, 32832 ; flush to zero, denormals are zero
  store i32 %within, ptr %new
  call void @llvm.x86.sse.ldmxcsr(ptr %new)
  call void @steps(ptr %slots)
  call void @llvm.x86.sse.ldmxcsr(ptr %old)
  ret void
}"""
_ARM = """\
declare i64 @llvm.aarch64.get.fpcr()
declare void @llvm.aarch64.set.fpcr(i64)
define void @run(ptr noalias %slots) nounwind {
  %before = call i64 @llvm.aarch64.get.fpcr()
  %within = or i64 %before, 16777216 ; flush to zero
  call void @llvm.aarch64.set.fpcr(i64 %within)
  call void @steps(ptr %slots)
  call void @llvm.aarch64.set.fpcr(i64 %before)
  ret void
}"""
_OTHER = """\
define void @run(ptr noalias %slots) nounwind {
  call void @steps(ptr %slots)
  ret void
}"""
_ENTRIES = {"x86_64": _X86, "AMD64": _X86, "aarch64": _ARM, "arm64": _ARM}

ATTRIBUTES = " ".join(
    f'"denormal-fp-math{suffix}"="preserve-sign,preserve-sign"' for suffix in ("", "-f32")
)
"""What LLVM must know to fold constants as the processor would."""


def entry() -> str:
    """Return the function `run` as text for LLVM, which calls `steps` and is all that is called."""
    # A function of its own, because LLVM moves arithmetic over neither end of a call.
    return _ENTRIES.get(platform.machine(), _OTHER)
