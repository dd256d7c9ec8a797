"""The kinds of value in a scenario file, each with its check, its sentence and its JSON schema.

Numbers are real numbers only: neither truth values nor text that looks like a number. Values that
are not finite pass here; they are refused for the whole file at once.
"""

from collections.abc import Iterable
from typing import Annotated, Any, Literal, final

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    GetCoreSchemaHandler,
    PlainValidator,
    WithJsonSchema,
)
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

from echelon.scenario.yaml import shown


@final
class OneOf:
    """Marks text that must be one of the names of a registry table."""

    def __init__(self, names: Iterable[str]) -> None:
        self.names = list(names)

    def __get_pydantic_core_schema__(
        self, source: type, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        # `Literal[*names]` says the same, and no type checker reads it
        return core_schema.literal_schema(self.names)


@final
class Allowed:
    """Marks a type of which one sentence says what is allowed, whichever part of it fails."""

    def __init__(self, phrase: str) -> None:
        self.phrase = phrase

    def __get_pydantic_core_schema__(
        self, source: type, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        return core_schema.custom_error_schema(
            handler(source), "allowed", custom_error_message=self.phrase
        )


def _weighted(edge: object) -> object:
    """Return an edge with its weight, 1 unless it is given."""
    if not isinstance(edge, list) or len(edge) not in (2, 3):
        raise PydanticCustomError("allowed", "is a pair `[i, j]` or a triple `[i, j, weight]`")
    return (*edge, 1.0)[:3]


def _refuse_loop(edge: tuple[int, int, float]) -> tuple[int, int, float]:
    if edge[0] == edge[1]:
        raise PydanticCustomError("allowed", "is an edge between two different agents")
    return edge


def _square(value: tuple[Any, ...]) -> tuple[tuple[float, ...], ...]:
    """Return a square matrix as rows; a list of numbers is its diagonal."""
    size = len(value)
    rows = [
        row if isinstance(row, tuple) else (0.0,) * i + (row,) + (0.0,) * (size - 1 - i)
        for i, row in enumerate(value)
    ]
    if any(len(row) != size for row in rows):
        raise ValueError(rows)
    return tuple(rows)


def _numeric(value: object) -> object:
    """Return a number or nested lists of numbers with lists as tuples."""
    if isinstance(value, list):
        return tuple(map(_numeric, value))
    if isinstance(value, bool) or not isinstance(value, int | float):
        # names the one number in question: its place inside a long list stays unknown otherwise
        said = f"got {shown(value)}, allowed is a number or a nested list of numbers."
        raise PydanticCustomError("sentence", "{said}", {"said": said})
    return value


FOLDER_NAME = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$"
CLASS_IN_FILE = r"^.+\.py:[A-Za-z_][A-Za-z0-9_]*$"

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Count = Annotated[int, Field(ge=1)]
Seed = Annotated[int, Field(ge=0, lt=2**63)]
Agent = Annotated[int, Field(ge=0)]
Agents = Annotated[tuple[Agent, ...], Field(strict=False)]
Edge = Annotated[
    tuple[Agent, Agent, Positive],
    BeforeValidator(
        _weighted, json_schema_input_type=tuple[Agent, Agent] | tuple[Agent, Agent, Positive]
    ),
    AfterValidator(_refuse_loop),
]
Edges = Annotated[tuple[Edge, ...], Field(strict=False)]
Numbers = Annotated[tuple[float, ...], Field(strict=False, min_length=1)]
Matrix = Annotated[
    Numbers | Annotated[tuple[Numbers, ...], Field(strict=False, min_length=1)],
    AfterValidator(_square),
]
Array = Annotated[
    Matrix, Allowed("is a list of numbers (the diagonal) or a list of as many rows as columns")
]
MatrixOrIdentity = Annotated[
    Literal["identity"] | Matrix,
    Allowed("is `identity`, a list of numbers (the diagonal) or a square matrix"),
]
Numeric = Annotated[Any, PlainValidator(_numeric), WithJsonSchema({"type": ["number", "array"]})]
Parameters = Annotated[
    str | dict[str, Any] | None,
    Allowed("is the name of a set of parameters or a mapping from names to values"),
]
