"""The registry of methods: what is told of each, and packages that bring one, sound and broken."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from advtex_contract.options import JobOptions, chosen_options
from advtex_options.methods import BUILT_IN, METHOD_HELP, Method, chosen_method, known_methods

OURS = [method.name for method in BUILT_IN]
SOUND = """
from advtex_options.methods import Method
METHOD = Method({name!r}, "each face from the latest view", "latest.texture:latest")
"""
Install = Callable[[str, str], None]


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """Makes a package of the name be there, whose only module `<name>_method` is as given."""
    monkeypatch.syspath_prepend(tmp_path)
    loaded = set(sys.modules)

    def make(package: str, module: str) -> None:
        about = tmp_path / f"{package}-1.0.dist-info"
        about.mkdir()
        (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
        (about / "entry_points.txt").write_text(f"[advtex.methods]\nlatest = {package}_method:METHOD\n")
        (tmp_path / f"{package}_method.py").write_text(module)
        known_methods.cache_clear()

    yield make
    for name in set(sys.modules) - loaded:
        if name.endswith("_method"):
            del sys.modules[name]
    known_methods.cache_clear()


def test_names_are_told_apart() -> None:
    assert len(set(OURS)) == len(OURS)
    assert list(METHOD_HELP) == OURS, "no package brings a method where tests run"
    assert JobOptions().method is None


@pytest.mark.parametrize(
    ("asked", "preset", "chosen"),
    [
        (None, "auto", "view_selection"),
        (None, "standard", "adversarial"),
        (None, "paper", "adversarial"),
        ("adversarial", "auto", "adversarial"),
        ("view_selection", "preview", "view_selection"),
        ("gabor", "auto", "view_selection"),
        ("l1", "paper", "l1"),
    ],
)
def test_it_is_view_selection_unless_a_recipe_of_the_adversarial_method_is_asked_for(
    asked: str | None, preset: str, chosen: str
) -> None:
    assert chosen_method(asked, preset) == chosen
    assert chosen in known_methods()


def test_a_job_that_was_accepted_under_an_earlier_name_is_one_still(install: Install) -> None:
    install("other", SOUND.format(name="gabor"))
    assert list(known_methods()) == OURS, "the name is taken"
    assert chosen_options({"method": "gabor"}).method == "gabor"
    assert "gabor" not in list(METHOD_HELP), "and it is not offered"


def test_a_package_brings_a_method(install: Install) -> None:
    install("latest", SOUND.format(name="latest"))
    assert list(known_methods()) == [*OURS, "latest"]
    assert METHOD_HELP["latest"] == "each face from the latest view"
    assert chosen_options({"method": "latest"}).method == "latest"
    assert JobOptions.model_json_schema()["properties"]["method"]["anyOf"][0]["enum"] == [*OURS, "latest"]


def test_a_package_that_is_imported_before_the_registry_is_asked(install: Install) -> None:
    install("latest", SOUND.format(name="latest"))
    record = __import__("latest_method").METHOD
    assert known_methods()["latest"] is record


@pytest.mark.parametrize(
    ("module", "reason"),
    [
        ("import no_such_module", "ModuleNotFoundError: No module named 'no_such_module'"),
        ("1 / 0", "ZeroDivisionError"),
        ("METHODS = []", "AttributeError"),
        ("METHOD = 'latest'", "TypeError: broken_method:METHOD is a str"),
        (SOUND.format(name="mean"), "the name mean is taken"),
        (SOUND.format(name="Latest View"), "'Latest View' is no name of a method"),
        (SOUND.format(name="latest").replace("latest.texture:", ""), "'latest' is no function"),
        (SOUND.format(name="latest").replace('latest")', 'latest", plays_game=True)'), "set draws_pairs"),
    ],
    ids=["import", "error", "attribute", "type", "taken", "name", "function", "game"],
)
def test_one_that_cannot_be_used_is_left_out_and_told(
    install: Install, caplog: pytest.LogCaptureFixture, module: str, reason: str
) -> None:
    install("sound", SOUND.format(name="sound"))
    install("broken", module)
    with caplog.at_level(logging.WARNING):
        assert list(known_methods()) == [*OURS, "sound"]
        known_methods()
    (told,) = caplog.messages
    assert told.startswith("the method latest of the package broken is left out: ")
    assert reason in told
    assert told.endswith("; mend, update or uninstall the package")
    assert "\n" not in told


def test_of_two_packages_with_one_name_the_first_has_it(install: Install, caplog: pytest.LogCaptureFixture) -> None:
    for package in ("b", "a"):
        install(package, SOUND.format(name="latest").replace("latest.texture", f"{package}.texture"))
    assert known_methods()["latest"].function == "a.texture:latest"
    (told,) = caplog.messages
    assert "of the package b is left out: ValueError: the name latest is taken" in told


def test_a_record_needs_nothing_but_its_function() -> None:
    method = Method("latest", "each face from the latest view", "latest:latest")
    assert not (method.draws_pairs or method.plays_game or method.refines_cameras or method.weights)
