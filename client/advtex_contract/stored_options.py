"""Options as a row or an answer holds them: another version may have written them.

Whoever shows them takes them as they are. A worker, which acts on them, has to know all of them (`misunderstood`), and
what is submitted is a `JobOptions` and nothing else.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import BeforeValidator, Field, TypeAdapter, create_model

from advtex_contract.options import GivenOnly, JobOptions, known_options
from advtex_options import Options

if TYPE_CHECKING:

    class OtherOptions(GivenOnly, Options, frozen=True):
        preset: Any = None
        method: Any = None
        width: Any = None
        height: Any = None
else:
    OtherOptions = create_model(
        "OtherOptions",
        __base__=GivenOnly,
        __module__=__name__,
        __doc__="Options with values that are not known here, as another version has written them.",
        **{name: (Any, field.default) for name, field in JobOptions.model_fields.items()},
    )


def _known_names(stored: object) -> object:
    return known_options(stored) if isinstance(stored, Mapping) else stored


AnyOptions = Annotated[
    JobOptions | OtherOptions,
    Field(union_mode="left_to_right"),
    BeforeValidator(_known_names, json_schema_input_type=Any),
]
_ADAPTER: TypeAdapter[JobOptions | OtherOptions] = TypeAdapter(AnyOptions)


def read_options(stored: object) -> JobOptions | OtherOptions:
    """The options, with whatever values they have, and without the names that are not known here."""
    return _ADAPTER.validate_python(stored)
