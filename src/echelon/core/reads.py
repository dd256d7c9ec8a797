"""What the code of a class or function reads beside its arguments, as far as Python shows it.

Globals, closures, defaults and class attributes may change while a process runs; what was computed
with them must not be taken for what is computed now.
"""

import functools
import sys
import sysconfig
from collections.abc import Iterator
from types import CodeType, FunctionType, ModuleType

_SPECIAL = {"__dict__", "__weakref__", "__doc__", "__module__", "__annotations__", "__slots__"}
_LIBRARIES = tuple(sysconfig.get_paths()[name] for name in ("stdlib", "purelib", "platlib"))


def is_installed(home: str) -> bool:
    """Return whether a module is of Python or of an installed package, and so does not change."""
    return _is_installed(home.partition(".")[0], id(sys.modules.get(home)))


@functools.lru_cache(1024)
def _is_installed(package: str, _: int) -> bool:
    file = getattr(sys.modules.get(package), "__file__", None)
    return package in sys.stdlib_module_names - {"__main__"} or bool(
        file and file.startswith(_LIBRARIES)
    )


def reads(named: type | FunctionType) -> Iterator[object]:
    """Yield what the code of a class or function reads, each value with its name before it."""
    if isinstance(named, type):
        for base in named.__mro__:
            if base is named or not (is_installed(base.__module__) or base is object):
                yield from _attributes(base)
    else:
        yield from _of_function(named)


def _attributes(kind: type) -> Iterator[object]:
    for name, value in vars(kind).items():
        if name in _SPECIAL or name.startswith(("__dataclass", "_abc", "__abstract", "__jax")):
            continue
        functions = list(_functions(value))
        for function in functions:
            yield from _of_function(function)
        # What calls nothing is a value that code may read.
        if not functions and not callable(value):
            yield name
            yield value


def _functions(value: object) -> Iterator[FunctionType]:
    """Yield the functions behind a method, a property, or a wrapper of one."""
    if isinstance(value, FunctionType):
        yield value
        value = getattr(value, "__wrapped__", None)
    for name in ("__func__", "__wrapped__", "method", "fget", "func"):
        inner = getattr(value, name, None)
        if isinstance(inner, FunctionType):
            yield inner


def _of_function(function: FunctionType) -> Iterator[object]:
    yield from (function.__qualname__, function.__defaults__, function.__kwdefaults__)
    for cell in function.__closure__ or ():
        try:
            yield cell.cell_contents
        except ValueError:
            # Not yet filled.
            continue
    codes = [function.__code__]
    while codes:
        code = codes.pop()
        yield code.co_code
        codes += [const for const in code.co_consts if isinstance(const, CodeType)]
        yield from (const for const in code.co_consts if not isinstance(const, CodeType))
        for name in code.co_names:
            if name in function.__globals__:
                yield name
                yield from _global(function.__globals__[name], code.co_names)


def _global(value: object, names: tuple[str, ...]) -> Iterator[object]:
    """Yield a global, or of somebody's own module what the code may read of it."""
    if not isinstance(value, ModuleType):
        yield value
    elif not is_installed(value.__name__) and not value.__name__.startswith("echelon"):
        for name in names:
            if name in vars(value):
                yield name
                yield vars(value)[name]
