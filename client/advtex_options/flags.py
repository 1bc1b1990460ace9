"""Flags of a command line, the same for every command that has them: the options, and the version."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import Annotated, Any, TypeVar

import typer

from advtex_options.options import described, kind_of, refusal
from advtex_scan.version import product_version

T = TypeVar("T")


def option_flags(command: Callable[..., T]) -> Callable[..., T]:
    """The command with a flag per option in place of its parameter `given`.

    It is called with those that were given, by name, as they were written: nothing is checked yet, and a size is text.
    """
    names = tuple(described())
    parameters: list[inspect.Parameter] = []
    for parameter in inspect.signature(command, eval_str=True).parameters.values():
        here = map(_parameter, names) if parameter.name == "given" else [parameter]
        parameters += (one.replace(kind=inspect.Parameter.KEYWORD_ONLY) for one in here)

    @functools.wraps(command)
    def called(**arguments: Any) -> T:
        given = {name: arguments.pop(name) for name in names}
        return command(**arguments, given={name: value for name, value in given.items() if value is not None})

    called.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    called.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return called


def layout_of(name: str | None) -> str | None:
    """The callback of a flag `--layout` by itself: refuses names that are none."""
    if name is not None and (words := refusal("layout", name)) is not None:
        raise typer.BadParameter(words)
    return name


def flag(name: str, **more: Any) -> Any:
    """The option's flag, for an annotation."""
    about = described()[name]
    words = [about.help]
    if about.choices is not None:
        words.append("; ".join(f"{word}: {help_}" if help_ else word for word, help_ in about.choices.items()))
    if about.bounds:
        words.append(about.bounds)
    metavar = about.form or ("WxH" if name == "size" else "NAME" if about.choices is not None else "N")
    more |= {} if kind_of(name) is bool else {"metavar": metavar}
    return typer.Option(f"--{name.replace('_', '-')}", help=". ".join(words), show_default=about.unset, **more)


def version_flag(program: str) -> Any:
    """The flag `--version` of a program, for an annotation: prints its name and version, and ends it."""

    def printed(asked: bool) -> None:
        if asked:
            typer.echo(f"{program} {product_version()}")
            raise typer.Exit

    return typer.Option("--version", callback=printed, is_eager=True, help="print the version and exit")


LayoutFlag = Annotated[str | None, flag("layout", callback=layout_of)]
"""For commands that have this option alone."""


def _parameter(name: str) -> inspect.Parameter:
    kind: Any = kind_of(name) | None
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=Annotated[kind, flag(name)])
