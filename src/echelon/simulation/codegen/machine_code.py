"""Machine code from text for LLVM, cached on disk, and called by address."""

import ctypes
import hashlib
import platform
from functools import cache
from types import ModuleType
from typing import Any, final

import numpy as np

from echelon.core.cache import load_or_compile
from echelon.core.errors import MissingExtraError
from echelon.core.trace import error_summary
from echelon.simulation.scalars import Unsupported


@cache
def llvm() -> ModuleType:
    """Return llvmlite's binding for this machine; `MissingExtraError` if it is not installed."""
    # Not at the top: it comes with an extra, and is slow to import.
    try:
        import llvmlite.binding as binding
    except ImportError:
        raise MissingExtraError(
            "the native engine needs llvmlite; "
            "install it with `pip install '.[fast]'` in echelon's clone."
        ) from None
    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    return binding


def is_installed() -> bool:
    """Tell whether native code can be generated on this machine."""
    try:
        llvm()
    except MissingExtraError:
        return False
    return True


_LINKED = platform.system() != "Windows"
"""Whether code and constants are linked side by side: elsewhere they may be anywhere in memory, and
code of the small model, which reaches only 2 GiB far, would crash the process."""
_MODEL = "small" if _LINKED else "jitdefault"
_WIDTHS = {"avx512f": 512, "avx2": 256, "avx": 256}


def vectors() -> str:
    """Return the processor and the vectors that native code uses here, in words."""
    if not is_installed():
        return "none; `pip install '.[fast]'` in echelon's clone"
    has = set(features().split(","))
    width = next((bits for name, bits in _WIDTHS.items() if f"+{name}" in has), 128)
    fused = "with" if has & {"+fma", "+neon", "+fp-armv8"} else "without"
    return f"{llvm().get_host_cpu_name()}, vectors of {width} bits, {fused} fused multiply-add"


@cache
def features() -> str:
    """Return the features of this machine's processor, as LLVM writes them."""
    return llvm().get_host_cpu_features().flatten()


@final
class Code:
    """A kernel as machine code, which exists as long as this object."""

    def __init__(self, text: str) -> None:
        binding = llvm()
        import llvmlite

        target = binding.Target.from_default_triple()
        # In the small model a constant is an operand; no address is loaded first.
        self._machine = target.create_target_machine(
            cpu=binding.get_host_cpu_name(),
            features=features(),
            opt=3,
            codemodel=_MODEL,
            reloc="pic" if _LINKED else "default",
        )
        # All that the code depends on: another processor or LLVM compiles anew.
        parts = [text, _MODEL, features(), binding.get_host_cpu_name(), llvmlite.__version__]
        parts += [platform.system(), platform.machine()]
        image = load_or_compile(lambda: _compiled(binding, self._machine, text), *parts)
        self._jit = binding.create_lljit_compiler(self._machine, use_jit_link=_LINKED)
        name = f"kernel_{hashlib.sha256(text.encode()).hexdigest()[:12]}"
        builder = binding.JITLibraryBuilder().add_object_img(image).export_symbol("run")
        self._library = builder.link(self._jit, name)
        self._run = ctypes.CFUNCTYPE(None, ctypes.c_void_p)(self._library["run"])

    def call(self, slots: np.ndarray) -> None:
        """Run the kernel with the arguments in 64-bit slots: addresses and whole numbers."""
        self._run(slots.ctypes.data)


def _compiled(binding: ModuleType, machine: Any, text: str) -> bytes:
    try:
        module = binding.parse_assembly(text)
        module.verify()
    except RuntimeError as error:
        raise Unsupported(f"code that LLVM rejects ({error_summary(error)})") from error
    options = binding.create_pipeline_tuning_options(speed_level=2)
    # Kernels consist of vectors already, a lane for each agent.
    options.loop_vectorization = options.slp_vectorization = False
    passes = binding.create_pass_builder(machine, options)
    passes.getModulePassManager().run(module, passes)
    return machine.emit_object(module)


def aligned(shape: tuple[int, ...], dtype: np.dtype | type) -> np.ndarray:
    """Return zeros that begin at a multiple of 64 bytes, as stores of vectors require."""
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    memory = np.zeros(size + 64, np.uint8)
    start = -memory.ctypes.data % 64
    return memory[start : start + size].view(dtype).reshape(shape)
