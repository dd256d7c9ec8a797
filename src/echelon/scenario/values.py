"""The kinds of value in a scenario file, each with its check, its sentence and its JSON schema.

Numbers are real numbers only: neither truth values nor text that looks like a number. Values that
are not finite pass here; they are refused for the whole file at once.
"""

from collections.abc import Iterable
from typing import Annotated, Any, Literal, NoReturn, final

from pydantic import (
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    PlainValidator,
    WithJsonSchema,
)
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

from echelon.core.errors import did_you_mean
from echelon.scenario.yaml import are, shown


def _refuse(value: object, allowed: str) -> NoReturn:
    said = f"got {shown(value)}, allowed {allowed}."
    raise PydanticCustomError("echelon", "{said}", {"said": said})


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _float(value: int | float) -> float:
    try:
        return float(value)
    except OverflowError:  # refused elsewhere, as every number that is not finite
        return float("inf")


@final
class OneOf:
    """Marks text that must be one of the names of a registry table."""

    def __init__(self, names: Iterable[str]) -> None:
        self.names = tuple(names)

    def __get_pydantic_core_schema__(
        self, source: type, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        return core_schema.no_info_after_validator_function(self.check, handler(source))

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        return {**handler(schema), "enum": list(self.names)}

    def check(self, name: str) -> str:
        """Return the name, or refuse it and say which are allowed."""
        if name not in self.names:
            _refuse(name, f"{are(self.names)}{did_you_mean(name, self.names)}")
        return name


def _edge(value: object) -> tuple[int, int, float]:
    if not isinstance(value, list) or len(value) not in (2, 3):
        _refuse(value, "is a pair `[i, j]` or a triple `[i, j, weight]`")
    (i, j), weight = value[:2], value[2] if len(value) == 3 else 1.0
    if not all(type(agent) is int and agent >= 0 for agent in (i, j)):
        _refuse(value, "are two agents, whole numbers from 0, and a weight")
    if i == j:
        _refuse(value, "is an edge between two different agents")
    if not _is_number(weight) or weight <= 0:
        _refuse(value, "is a weight above 0")
    return i, j, _float(weight)


def _matrix(value: object) -> tuple[tuple[float, ...], ...]:
    """Return a square matrix as rows; a list of numbers is its diagonal."""
    rows = value if isinstance(value, list) else []
    size = len(rows)
    if rows and all(map(_is_number, rows)):
        diagonal = [_float(number) for number in rows]
        return tuple(
            tuple(diagonal[i] if i == j else 0.0 for j in range(size)) for i in range(size)
        )
    square = all(
        isinstance(row, list) and len(row) == size and all(map(_is_number, row)) for row in rows
    )
    if not rows or not square:
        _refuse(value, "is a list of numbers (the diagonal) or a list of as many rows as columns")
    return tuple(tuple(map(_float, row)) for row in rows)


def _matrix_or_identity(value: object) -> Literal["identity"] | tuple[tuple[float, ...], ...]:
    if isinstance(value, str):
        if value != "identity":
            said = "is `identity`, a list of numbers (the diagonal) or a square matrix"
            _refuse(value, said + did_you_mean(value, ["identity"]))
        return "identity"
    return _matrix(value)


def _numeric(value: object) -> object:
    """Return a number or nested lists of numbers with lists as tuples."""
    if isinstance(value, list):
        return tuple(map(_numeric, value))
    if not _is_number(value):
        _refuse(value, "is a number or a nested list of numbers")
    return value


def _parameters(value: object) -> str | dict[str, Any] | None:
    named = isinstance(value, dict) and all(isinstance(key, str) for key in value)
    if value is not None and not isinstance(value, str) and not named:
        _refuse(value, "is the name of a set of parameters or a mapping from names to values")
    return value  # pyright: ignore[reportReturnType]


FOLDER_NAME = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$"
CLASS_IN_FILE = r"^.+\.py:[A-Za-z_][A-Za-z0-9_]*$"
_ROWS = {"type": "array", "items": {"type": "array", "items": {"type": "number"}}}
_DIAGONAL = {"type": "array", "items": {"type": "number"}, "minItems": 1}
_EDGE = {
    "type": "array",
    "prefixItems": [{"type": "integer", "minimum": 0}] * 2
    + [{"exclusiveMinimum": 0, "type": "number"}],
    "minItems": 2,
    "maxItems": 3,
}

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Count = Annotated[int, Field(ge=1)]
Seed = Annotated[int, Field(ge=0, lt=2**63)]
Numbers = Annotated[tuple[float, ...], Field(strict=False, min_length=1)]
Agents = Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(strict=False)]
Edge = Annotated[tuple[int, int, float], PlainValidator(_edge), WithJsonSchema(_EDGE)]
Edges = Annotated[tuple[Edge, ...], Field(strict=False)]
Array = Annotated[
    tuple[tuple[float, ...], ...],
    PlainValidator(_matrix),
    WithJsonSchema({"anyOf": [_DIAGONAL, _ROWS]}),
]
MatrixOrIdentity = Annotated[
    Literal["identity"] | tuple[tuple[float, ...], ...],
    PlainValidator(_matrix_or_identity),
    WithJsonSchema({"anyOf": [{"const": "identity"}, _DIAGONAL, _ROWS]}),
]
Numeric = Annotated[Any, PlainValidator(_numeric), WithJsonSchema({"type": ["number", "array"]})]
Parameters = Annotated[
    str | dict[str, Any] | None,
    PlainValidator(_parameters),
    WithJsonSchema({"type": ["string", "object", "null"]}),
]
