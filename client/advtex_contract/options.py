"""The options of a job as the API takes them, made of their one description."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, Self, get_type_hints

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    ValidationError,
    ValidationInfo,
    ValidatorFunctionWrapHandler,
    create_model,
    field_validator,
    model_serializer,
    model_validator,
)
from pydantic_core import PydanticCustomError

from advtex_options import SIZE, Options, described, parse_size, refusal
from advtex_options.words import PRESET_COST, PRESET_HELP, Preset

__all__ = ["PRESET_COST", "PRESET_HELP", "JobOptions", "Preset", "chosen_options"]


class GivenOnly(BaseModel, frozen=True):
    """Written without what is not given: a reader of another release refuses a name that it does not know."""

    @model_serializer(mode="wrap")
    def _given(self, write: SerializerFunctionWrapHandler):  # type: ignore[no-untyped-def]
        # no return annotation: it would take the place of the fields in the API's description
        usual = {name: field.default for name, field in type(self).model_fields.items()}
        return {name: value for name, value in write(self).items() if value is not None or usual[name] is not None}


class _Checked(GivenOnly, frozen=True):
    """What is checked of the options, and told in the same words as everywhere else."""

    model_config = ConfigDict(extra="forbid")

    @field_validator("*", mode="wrap")
    @classmethod
    def _refused_in_words(cls, value: object, check: ValidatorFunctionWrapHandler, info: ValidationInfo) -> Any:
        assert info.field_name is not None
        try:
            checked = check(value)
            if checked is not None and (words := _malformed(info.field_name, checked)) is not None:
                raise PydanticCustomError("form", "{words}", {"words": words})
            return checked
        except ValidationError as error:
            if (words := refusal(info.field_name, value)) is None:
                raise
            raise PydanticCustomError(error.errors()[0]["type"], "{words}", {"words": words}) from error

    @model_validator(mode="after")
    def _size_is_whole(self) -> Self:
        if (getattr(self, "width") is None) != (getattr(self, "height") is None):  # noqa: B009
            raise ValueError("width and height go together: give both or neither")
        return self


def _described_fields() -> dict[str, Any]:
    """Types and fields by name, as `create_model` takes them, `size` in two.

    Their order is kept: what a client remembers of a submission is found by the options' JSON.
    """
    made: dict[str, Any] = {}
    types = get_type_hints(Options)
    for name, about in described().items():
        if name == "size":
            words = f"{SIZE.help}; left out: {SIZE.unset}"
            side = (int | None, Field(default=None, description=words, ge=SIZE.low, le=SIZE.high))
            made |= {"width": side, "height": side}
            continue
        kind, default = _NARROWER.get(name, types[name]), getattr(Options, name)
        if name in _NARROWER:
            default = kind(default)
        words = about.help if default is not None else f"{about.help}; left out: {about.unset}"
        longest = (200 if about.form else 40) if kind in (str, str | None) else None
        offer = partial(_offer, about.choices) if name in _OPEN and about.choices is not None else None
        told: dict[str, Any] = {"description": words, "json_schema_extra": offer}
        if about.several and about.choices is not None:
            word = "|".join(map(re.escape, about.choices))
            longest, told["pattern"] = 200, f"^({word})(,({word}))*$"
        field = Field(default=default, ge=about.low, le=about.high, max_length=longest, **told)
        made[name] = (kind, field)
    return made


def _malformed(name: str, value: object) -> str | None:
    """What is wrong with a text that has a form, in words; None for all else."""
    about = described().get(name)
    return refusal(name, value) if about is not None and about.parse is not None else None


def _offer(choices: Mapping[str, str], schema: dict[str, Any]) -> None:
    """Describe an open word: one of those that are known where it is described, or another."""
    schema["anyOf"] = [{"type": "string", "enum": list(choices)}, *schema["anyOf"]]


_NARROWER: Mapping[str, Any] = {"preset": Preset}
_OPEN = {"layout", "method"}
"""Options whose words another version, or another installation, may have more of: not checked where jobs are read."""

if TYPE_CHECKING:

    class JobOptions(_Checked, Options, frozen=True):
        preset: Preset = Preset.auto
        width: int | None = None
        height: int | None = None
else:
    JobOptions = create_model(
        "JobOptions", __base__=_Checked, __module__=__name__, __doc__=Options.__doc__, **_described_fields()
    )


def chosen_options(given: Mapping[str, Any], usual: JobOptions | None = None) -> JobOptions:
    """`usual` with what was given instead, as flags and columns have it: by name, `size` in one word.

    Raises ValueError, in a sentence, for what cannot be used.
    """
    given = dict(given)
    if (size := given.pop("size", None)) is not None:
        sides = parse_size(str(size))
        if (words := refusal("size", sides)) is not None:
            raise ValueError(words)
        given["width"], given["height"] = sides
    for name in given.keys() & _OPEN:
        if given[name] is not None and (words := refusal(name, given[name])) is not None:
            raise ValueError(words)
    try:
        return JobOptions.model_validate((usual or JobOptions()).model_dump() | given)
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(map(str, first["loc"]))
        told = first["msg"].removeprefix("Value error, ")
        raise ValueError(told if name in told else f"options.{name}: {told}") from error


def known_options(stored: Mapping[str, Any]) -> dict[str, Any]:
    """Stored options without those that only another version knows."""
    return {name: value for name, value in stored.items() if name in JobOptions.model_fields}


def misunderstood(stored: Mapping[str, Any]) -> str | None:
    """What stored options say that this version does not know, in a sentence; None where it knows all of it.

    Null under a name that it does not know is an option that was not given, and asks for nothing.
    """
    unknown = sorted(name for name in stored.keys() - JobOptions.model_fields.keys() if stored[name] is not None)
    if unknown:
        return f"there is no option {', '.join(unknown)}"
    try:
        chosen_options(known_options(stored))
    except ValueError as error:
        return str(error)
    return None
