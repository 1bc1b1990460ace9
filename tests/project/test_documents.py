"""What the pages and files around the code say is there: links, paths, make's targets, commands, settings, schemas."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from advtex_scan.layouts import LAYOUT_NAMES
from advtex_server.settings import ServerSettings
from advtex_store.settings import StoreSettings
from advtex_worker.settings import WorkerSettings

ROOT = Path(__file__).parents[2]
ROOMS = ("client", "server", "worker")
PAGES = sorted(
    [
        *ROOT.glob("*.md"),
        *(ROOT / ".github").rglob("*.md"),
        *(path for room in (*ROOMS, "docker") for path in (ROOT / room).glob("*.md")),
    ]
)
WORDS = [page for page in PAGES if page.name != "CHANGELOG.md"]  # which speaks of what was, too
TARGETS = set(re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
SCRIPTS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["scripts"]
SETTINGS = {"store": StoreSettings, "server": ServerSettings, "worker": WorkerSettings}
UNITS = {"MiB": 1 << 20, "GiB": 1 << 30, "days": 86400}
IN_WORDS = {
    "user's data folder",
    "SQLite in the data folder",
    "`blobs` in the data folder",
    "`work` in the data folder",
    "`scans` in the data folder",
    "20 GiB, if blobs are in S3",
}
IN_WORDS |= {"none", "the device's", "all cores"}


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def prose(page: Path) -> str:
    """Without blocks of code."""
    return re.sub(r"^(?:    .*\n)+", "", re.sub(r"^```.*?^```$", "", text_of(page), flags=re.M | re.S), flags=re.M)


def shell_lines(page: Path) -> Iterator[list[str]]:
    """The indented lines of a page as words, without comments; what is no shell is left out."""
    for line in re.findall(r"^    (\S.*)$", re.sub(r"^```.*?^```$", "", text_of(page), flags=re.M | re.S), re.M):
        try:
            words = shlex.split(line, comments=True)
        except ValueError:
            continue
        while words and re.fullmatch(r"[A-Z_]+=\S*", words[0]):
            words = words[1:]
        if words:
            yield words


def test_the_pages_are_where_they_are_looked_for() -> None:
    assert {"README.md", "CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md", "server/README.md", "worker/README.md"} <= {
        name_of(page) for page in PAGES
    }
    assert len(text_of(ROOT / "README.md").splitlines()) < 200


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_relative_link_leads_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        found = (page.parent / path).resolve() if path else page
        assert found.exists(), target
        assert found.is_relative_to(ROOT), target
        heads = (
            {
                re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-")
                for head in re.findall(r"^#+ (.*)$", text_of(found), re.M)
            }
            if anchor
            else set()
        )
        assert not anchor or anchor in heads, target


@pytest.mark.parametrize("page", WORDS, ids=name_of)
def test_every_file_that_is_named_exists(page: Path) -> None:
    """A path in backticks whose first part is a folder here, or beside the page, is one of the repository."""
    for base in (ROOT, page.parent):
        folders = {path.name for path in base.iterdir() if path.is_dir() and path.name not in {"demo", "scans"}}
        for named in re.findall(r"`([\w.-]+(?:/[\w.-]+)+)/?`", prose(page)):
            if named.partition("/")[0] in folders:
                assert (base / named).exists(), named


@pytest.mark.parametrize("page", WORDS, ids=name_of)
def test_every_target_of_make_exists(page: Path) -> None:
    named = set(re.findall(r"`make (\w+)", text_of(page))) | {
        word for words in shell_lines(page) if words[0] == "make" for word in words[1:] if "=" not in word
    }
    assert named <= TARGETS


def test_the_makefile_names_its_targets() -> None:
    makefile = text_of(ROOT / "Makefile")
    assert set(re.findall(r"^# make (\w+)", makefile, re.M)) == TARGETS
    (phony,) = re.findall(r"^\.PHONY: (.*)$", makefile, re.M)
    assert set(phony.split()) == TARGETS


def commands() -> dict[tuple[str, ...], set[str]]:
    """The subcommands of this project that pages call, each with the options that they give it."""
    found: dict[tuple[str, ...], set[str]] = {}
    for page in WORDS:
        for words in shell_lines(page):
            names = [Path(word).name for word in words]
            for start, name in enumerate(names):
                if name in SCRIPTS and (start == 0 or words[0] == "docker"):
                    rest = words[start + 1 :]
                    plain = [word for word in rest[:2] if re.fullmatch(r"[a-z]+(-[a-z]+)*", word)]
                    depth = 2 if plain[:1] in (["batch"], ["keys"]) else 1
                    options = {word for word in rest if re.match(r"--?[a-z]", word)}
                    found.setdefault((name, *plain[:depth]), set()).update(options)
    return found


def test_pages_call_commands_of_all_kinds() -> None:
    assert {name for name, *_ in commands()} >= {"advtex-client", "advtex-server", "advtex-engine"}
    assert len(commands()) > 15


@pytest.mark.parametrize(
    ("command", "options"),
    commands().items(),
    ids=lambda value: " ".join(sorted(value) if isinstance(value, set) else value),
)
def test_every_command_that_is_shown_has_its_options(command: tuple[str, ...], options: set[str]) -> None:
    module, _, function = SCRIPTS[command[0]].partition(":")
    code = f"import sys; from {module} import {function} as main; sys.exit(main())"
    line = [sys.executable, "-c", code, *command[1:], "--help"]
    environment = {"PYTHONPATH": ":".join(sys.path), "COLUMNS": "300", "TERM": "dumb"}
    done = subprocess.run(line, capture_output=True, text=True, timeout=120, check=False, env=environment)
    assert done.returncode == 0, done.stderr
    known = set(re.findall(r"(?<![\w-])--?[a-z][a-z-]*", done.stdout))
    assert options <= known | {"--"}


def test_the_settings_are_all_described_with_their_defaults() -> None:
    rows = re.findall(r"^\| `ADVTEX_(\w+)` \| (.*?) \|", text_of(ROOT / "server" / "README.md"), re.M)
    defaults = dict(rows)
    fields = {name.upper(): field for kind in SETTINGS.values() for name, field in kind.model_fields.items()}
    assert len(rows) == len(defaults)
    assert defaults.keys() == fields.keys()
    for name, said in defaults.items():
        if said in IN_WORDS:
            assert fields[name].default_factory is not None or not fields[name].default, name
            continue
        number, _, unit = said.partition(" ")
        value = float(number) * UNITS[unit] if unit else said.strip("`")
        default = fields[name].default
        expected = json.dumps(default) if isinstance(default, bool) else default
        assert type(expected)(value) == expected, name


def test_the_readme_tells_of_every_layout() -> None:
    """By the words of its users, so the rows are counted: some layouts share one, native has its own words."""
    table = text_of(ROOT / "README.md").partition("| scan | give |")[2].partition("\n\n")[0]
    assert len(table.splitlines()) - 2 == len(LAYOUT_NAMES) - 2  # native is no row, ScanNet's two are one


@pytest.mark.parametrize(
    ("schema", "files"),
    [
        ("github-workflows", [".github/workflows/ci.yml"]),
        ("github-issue-forms", sorted(p.name for p in (ROOT / ".github/ISSUE_TEMPLATE").glob("*.yml"))),
        ("github-issue-config", [".github/ISSUE_TEMPLATE/config.yml"]),
        ("citation-file-format", ["CITATION.cff"]),
    ],
)
def test_files_for_others_follow_their_schemas(schema: str, files: list[str]) -> None:
    if schema == "github-issue-forms":
        files = [f".github/ISSUE_TEMPLATE/{name}" for name in files if name != "config.yml"]
    linter = Path(sys.executable).with_name("check-jsonschema")
    command = [linter, "--builtin-schema", f"vendor.{schema}", "--force-filetype", "yaml", *files]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_others_machines_run_what_this_one_runs() -> None:
    workflow = yaml.safe_load(text_of(ROOT / ".github" / "workflows" / "ci.yml"))
    (job,) = workflow["jobs"].values()
    runs = [step["run"] for step in job["steps"] if "run" in step]
    assert runs == [".ci/run"]
    project = tomllib.loads(text_of(ROOT / "pyproject.toml"))["project"]
    named = [line.rpartition(" ")[2] for line in project["classifiers"] if " :: 3." in line]
    assert job["strategy"]["matrix"]["python"] == named
