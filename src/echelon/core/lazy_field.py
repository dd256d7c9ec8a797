"""Fields of a dataclass that are computed when they are first read."""

from collections.abc import Callable
from typing import Any, Generic, NamedTuple, TypeVar, final, overload

_T = TypeVar("_T")


class Later(NamedTuple, Generic[_T]):
    """A value that `compute` returns when it is first read."""

    compute: Callable[[], _T]


@final
class LazyField(Generic[_T]):
    """A field of a dataclass, without a default, that takes its value or a `Later`."""

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    @overload
    def __get__(self, instance: None, owner: type) -> "LazyField[_T]": ...

    @overload
    def __get__(self, instance: object, owner: type) -> _T: ...

    def __get__(self, instance: object | None, owner: type) -> Any:
        if instance is None:
            # A dataclass takes what its class holds under the name of a field for its default.
            raise AttributeError(f"`{self.name}` is a field of the instances.")
        value = vars(instance)[self.name]
        if isinstance(value, Later):
            value = vars(instance)[self.name] = value.compute()
        return value

    def __set__(self, instance: object, value: "_T | Later[_T]") -> None:
        vars(instance)[self.name] = value
