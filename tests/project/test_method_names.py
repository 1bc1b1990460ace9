"""What is true of one method and not of another is in its record: nothing else tests which method it is."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from advtex_options.methods import BUILT_IN

ROOT = Path(__file__).parents[2]
RECORDS = ROOT / "client" / "advtex_options" / "methods.py"
SOURCES = [path for room in ("client", "server", "worker") for path in sorted((ROOT / room).rglob("*.py"))]
SCRIPTS = [
    path for room in ("client", "server") for path in sorted((ROOT / room).rglob("*.js")) if "vendor" not in path.parts
]
NAMES = {method.name for method in BUILT_IN}
STARTS = {name[:length] for name in NAMES for length in range(3, len(name) + 1)}
IN_SCRIPT = re.compile(rf"""[!=]==?\s*["'`](?:{"|".join(NAMES)})["'`]|["'`](?:{"|".join(NAMES)})["'`]\s*[!=]==?""")


def words(node: ast.AST) -> set[str]:
    """The string of a literal, or those of a tuple, list or set of them."""
    parts = node.elts if isinstance(node, ast.Tuple | ast.List | ast.Set) else [node]
    return {part.value for part in parts if isinstance(part, ast.Constant) and isinstance(part.value, str)}


def comparisons(source: str) -> Iterator[int]:
    """The lines in which a value is compared with a method's name, or looked up by several of them."""
    for node in ast.walk(ast.parse(source)):
        match node:
            case ast.Compare(left=left, comparators=others):
                found = any(words(one) & NAMES for one in (left, *others))
            case ast.Call(func=ast.Attribute(attr="startswith" | "endswith" | "removeprefix"), args=[start, *_]):
                found = bool(words(start) & STARTS)
            case ast.MatchValue(value=value):
                found = bool(words(value) & NAMES)
            case ast.Dict(keys=keys):
                found = len(set().union(*(words(key) for key in keys if key is not None)) & NAMES) > 1
            case _:
                continue
        if found:
            yield node.lineno


@pytest.mark.parametrize(
    "source",
    [
        "method == 'vgg'",
        "'vgg' != config.method",
        "method in ('l1', 'vgg')",
        "method not in {'mean'}",
        "method.startswith('adversarial')",
        "method.startswith(('adv', 'x'))",
        "match method:\n    case 'l1' | 'mean':\n        pass",
        "{'l1': 5, 'vgg': 4}[method]",
    ],
)
def test_a_test_of_a_name_is_seen(source: str) -> None:
    assert list(comparisons(source))


@pytest.mark.parametrize("source", ["losses['l1']", "{'l1': 0.5}", "key.startswith('adv_')", "start == 'zero'"])
def test_other_words_are_let_be(source: str) -> None:
    assert not list(comparisons(source))


def test_no_module_tests_which_method_it_is() -> None:
    assert RECORDS in SOURCES
    found = {
        str(path.relative_to(ROOT)): lines
        for path in SOURCES
        if path != RECORDS and (lines := list(comparisons(path.read_text(encoding="utf-8"))))
    }
    assert found == {}, "ask the method's record, or give it a field"


def test_no_script_of_the_page_does() -> None:
    assert SCRIPTS
    assert IN_SCRIPT.search('job.method === "vgg" ? 1 : 2')
    assert [path.name for path in SCRIPTS if IN_SCRIPT.search(path.read_text(encoding="utf-8"))] == []
