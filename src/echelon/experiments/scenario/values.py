"""Sections of a scenario file, and kinds of value: each with its check, sentence and JSON schema.

A number is neither a truth value nor text that looks like a number. Values that are not finite pass
here; they are refused for the whole file at once.
"""

import abc
import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Annotated, Any, ClassVar, Literal, Self, final

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    PlainValidator,
    ValidationError,
    WithJsonSchema,
    model_validator,
)
from pydantic_core import CoreSchema, InitErrorDetails, PydanticCustomError, core_schema

from echelon.core.errors import listing
from echelon.experiments.scenario.yaml import KeyPath, is_or_are

STRICT = ConfigDict(strict=True, extra="forbid", frozen=True, use_attribute_docstrings=True)
"""The configuration of every section."""


@final
class Allowed:
    """Marks a type with one phrase for what is allowed, whichever part of it fails.

    `names` are what a misspelt word may have meant; `schema` replaces the type's.
    """

    def __init__(
        self, phrase: str, names: Sequence[str] = (), schema: CoreSchema | None = None
    ) -> None:
        self.phrase, self.names, self.schema = phrase, names, schema

    def __get_pydantic_core_schema__(
        self, source: type, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        return core_schema.custom_error_schema(
            self.schema or handler(source),
            "allowed",
            custom_error_message=self.phrase,
            custom_error_context={"names": " ".join(self.names)},
        )


def Unit(text: str) -> Any:
    """Mark a number with its SI unit, `1` without one, for the schema and its page."""
    return Field(json_schema_extra={"unit": text})


@final
class TakenBy:
    """Marks a key that some choices of its section take; a key without a mark belongs to all."""

    def __init__(self, *choices: str, needed_by: Iterable[str] = ()) -> None:
        self.needed_by = tuple(needed_by)
        self.choices = (*self.needed_by, *choices)


def NeededBy(*choices: str) -> TakenBy:
    """Mark a key that some choices of its section need."""
    return TakenBy(needed_by=choices)


def marked_keys(section: type[BaseModel]) -> dict[str, TakenBy]:
    """Return the keys of a section that belong to some of its choices, such as laws, only."""
    marks = ((key, mark) for key, field in section.model_fields.items() for mark in field.metadata)
    return {key: mark for key, mark in marks if isinstance(mark, TakenBy)}


def foreign_keys(section: type[BaseModel], choice: str) -> list[str]:
    """Return the keys of a section that a choice does not take."""
    return [key for key, mark in marked_keys(section).items() if choice not in mark.choices]


Finding = tuple[KeyPath, str]
"""The path of a fault within its section, and its sentence."""


class Section(BaseModel, abc.ABC, **STRICT):
    """A section of the file, whose keys are checked one by one and then together."""

    one_of: ClassVar[tuple[str, ...]] = ()
    """Keys of which at most one is allowed; the first one counts where none is given."""

    def choice(self, key: str) -> object:
        """Return what the marks of keys mean by a choice, where this key of `one_of` makes it."""
        return getattr(self, key) if key in ("name", "method", "law") else key

    def faults(self) -> Iterator[Finding]:
        """Yield what is wrong between keys of the section; of an unknown key no sentence."""
        set_ = (key for key in self.one_of if key in self.model_fields_set)
        given = [key for key in set_ if getattr(self, key) is not None]
        if len(given) > 1:
            yield (), f"got {listing(given)}, allowed is one of them."
            return
        extra = self.model_config.get("json_schema_extra")
        if not given and isinstance(extra, dict) and "oneOf" in extra:
            yield (), f"got none of {listing(self.one_of)}, one is required."
            return
        choice = next((self.choice(key) for key in (*given, *self.one_of)), None)
        if not isinstance(choice, str):
            return
        fields = type(self).model_fields
        for key, mark in marked_keys(type(self)).items():
            if choice in mark.needed_by and getattr(self, key) is None:
                yield (key,), f"got nothing, `{choice}` needs this key."
        foreign = foreign_keys(type(self), choice)
        allowed = [key for key in fields if key not in {*self.one_of, *foreign}]
        takes = f"allowed {is_or_are(allowed)}" if allowed else "it takes no keys"
        for key in (key for key in foreign if key in self.model_fields_set):
            name = fields[key].alias or key
            yield (name,), f"got a key that `{choice}` does not take, {takes}."

    @model_validator(mode="after")
    def _agree(self) -> Self:
        found = list[InitErrorDetails]()
        for path, text in self.faults():
            kind = PydanticCustomError("fault", "{text}", {"text": text})
            found.append({"type": kind if text else "extra_forbidden", "loc": path, "input": None})
        if found:
            raise ValidationError.from_exception_data(type(self).__name__, found)
        return self


def either(*keys: str) -> ConfigDict:
    """Return the configuration of a section that has exactly one of the keys."""
    extra: Any = {"oneOf": [{"required": [key]} for key in keys]}
    return ConfigDict(json_schema_extra=extra)


def OneOf(names: Iterable[str]) -> Allowed:
    """Mark text that must be one of the names of a registry table."""
    listed = list(names)
    # `Literal[*names]` gives the same schema, but type checkers reject it
    return Allowed(is_or_are(listed), listed, core_schema.literal_schema(listed))


def NameOrUserClass(names: Iterable[str]) -> Allowed:
    """Mark what is a name of a registry table or a class in a user's file."""
    listed = list(names)
    return Allowed(f"{is_or_are(listed)}, or `python: file.py:Class`", listed)


def _weighted(edge: object) -> object:
    """Return an edge with its weight, by default 1."""
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
    if all(isinstance(number, float) for number in value):
        return tuple(
            tuple(number if i == j else 0.0 for j in range(size)) for i, number in enumerate(value)
        )
    if any(len(row) != size for row in value):
        raise ValueError("not square")
    return value


def _numeric(value: object) -> object:
    if isinstance(value, list):
        return tuple(map(_numeric, value))
    if isinstance(value, bool) or not isinstance(value, int | float):
        # the list may be long, so the message has only the value that is not a number
        allowed = "is a number or a nested list of numbers"
        raise PydanticCustomError("allowed", allowed, {"got": value})
    if isinstance(value, int) and abs(value) >= _WHOLE:
        allowed = "is a whole number below 2^63, or one with an exponent, as `1e23`"
        raise PydanticCustomError("allowed", allowed, {"got": value})
    return value


FolderName = Annotated[
    str,
    Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$"),
    Allowed("is text of up to 100 letters, digits, `.`, `_` and `-`, first a letter or a digit"),
]
ClassInFile = Annotated[
    str,
    Field(pattern=r"^.+\.py:[A-Za-z_][A-Za-z0-9_]*$"),
    Allowed("is a file and a class in it, as in `pendulum.py:Pendulum`"),
]
Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
_WHOLE = 2**63
"""The first whole number that NumPy and JAX cannot represent."""
Count = Annotated[int, Field(ge=1, lt=_WHOLE)]
Seed = Annotated[int, Field(ge=0, lt=_WHOLE)]
Agent = Annotated[int, Field(ge=0, lt=_WHOLE)]
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
Speed = Annotated[
    Literal["inf"] | Positive | Annotated[tuple[Positive, ...], Field(strict=False, min_length=1)],
    Allowed("is a positive number, a list of such, or `inf`", ["inf"]),
    AfterValidator(lambda speed: math.inf if speed == "inf" else speed),
]
Matrix = Annotated[
    Numbers | Annotated[tuple[Numbers, ...], Field(strict=False, min_length=1)],
    AfterValidator(_square),
]
WeightMatrix = Annotated[
    Matrix, Allowed("is a list of numbers (the diagonal) or a list of as many rows as columns")
]
MatrixOrIdentity = Annotated[
    Literal["identity"] | Matrix,
    Allowed("is `identity`, a list of numbers (the diagonal) or a square matrix", ["identity"]),
]
Numeric = Annotated[Any, PlainValidator(_numeric), WithJsonSchema({"type": ["number", "array"]})]
Parameters = Annotated[
    str | dict[str, Any] | None,
    Allowed("is the name of a set of parameters or a mapping from names to values"),
]
