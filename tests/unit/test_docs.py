"""What the documents say of files, functions, settings, flags and equations is there."""

import ast
import contextlib
import dataclasses
import io
import re
from functools import cache
from pathlib import Path

import pytest

from dsar.cli import main
from dsar.config import TrainConfig

ROOT = Path(__file__).parents[2]
LOG = ROOT / "docs" / "log"
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("benchmarks/**/README.md")])
LIVING = [page for page in PAGES if page.parent != LOG and page.name != "CHANGELOG.md"]
"""Pages that speak of the code as it is; log and changelog keep the names of their day."""
PACKAGES = {"dsar": ROOT, "dsar_exporters": ROOT / "exporters", "dsar_render": ROOT / "render"}
ROOMS = [ROOT, ROOT / "dsar", ROOT / "exporters", ROOT / "render", ROOT / "exporters" / "dsar_exporters"]
"""Folders from which a path in a document is meant."""
FENCE = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)
CODE = re.compile(r"`([^`\n]+)`")
SOURCE = re.compile(r"(?:[\w.-]+/)+[\w.-]+\.(?:py|mjs|md|json|svg|png|jpg|sh)|(?:[a-z_]+/)+|[a-z_]+\.py")
USERS = set("4x Capture SERIAL checkpoint exr garment images masks motion name ply previews runs".split())
"""First folders of paths in runs and captures, which are the user's."""
COMMANDS = ("check", "train", "export", "render", "eval", "stress", "crosscheck")


def named(page):
    """Return a page's name for a test."""
    return page.relative_to(ROOT).as_posix()


def prose(page):
    """Return a page's text without its blocks of code."""
    return FENCE.sub("", page.read_text())


def anchors(page):
    """Return what links into a page can end in, as GitHub makes it of headings."""
    headings = re.findall(r"^#+ (.+)$", prose(page), re.MULTILINE)
    plain = (re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", heading) for heading in headings)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in plain}


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_every_relative_link_resolves(page):
    links = re.findall(r"\]\(([^)\s]+)\)|<img src=\"([^\"]+)\"", prose(page))
    broken = []
    for target in (first or second for first, second in links):
        if target.startswith(("http:", "https:", "mailto:")):
            continue
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        if not file.exists() or (anchor and anchor not in anchors(file)):
            broken.append(target)
    assert broken == []


def paths_in(text):
    """Return the files and folders of ours that a text names as code."""
    spans = CODE.findall(text)
    return [span for span in spans if SOURCE.fullmatch(span) and span.split("/")[0] not in USERS]


@pytest.mark.parametrize("page", LIVING, ids=named)
def test_every_file_that_is_named_exists(page):
    missing = [
        path
        for path in paths_in(prose(page))
        if not any((room / path).exists() for room in ROOMS) and not list(ROOT.glob(f"dsar/**/{path}"))
    ]
    assert missing == []


def test_the_drawing_of_the_architecture_names_files_that_exist():
    text = " ".join(re.findall(r">([^<>]+)</text>", (ROOT / "docs" / "img" / "architecture.svg").read_text()))
    named = re.findall(r"[a-z_]+/[a-z_]+\.py|data/[a-z]+|dsar_[a-z]+", text)
    assert len(named) > 10
    assert [path for path in named if not any((room / path).exists() for room in ROOMS)] == []


@cache
def definitions(file):
    """Return the names that a module defines: functions, classes, constants, methods and fields."""
    found = set()

    def visit(body, prefix):
        for node in body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                found.add(prefix + node.name)
                if isinstance(node, ast.ClassDef):
                    visit(node.body, f"{prefix}{node.name}.")
            elif isinstance(node, ast.Assign | ast.AnnAssign):
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                found.update(prefix + target.id for target in targets if isinstance(target, ast.Name))

    visit(ast.parse(file.read_text()).body, "")
    return found | {name.rpartition(".")[2] for name in found}


def source(path):
    """Return the module that a document means by a path."""
    return next((room / path for room in ROOMS if (room / path).is_file()), None)


def words(text):
    """Yield each file that a text names together with each name that follows it at once."""
    file, end = None, 0
    for match in CODE.finditer(text):
        if not re.fullmatch(r"(?:,|and|or|\s)*", text[end : match.start()]):
            file = None
        if SOURCE.fullmatch(match[1]):
            file = source(match[1])
        elif file is not None:
            yield file, match[1]
        end = match.end()


@pytest.mark.parametrize("page", [ROOT / "docs" / "paper.md", ROOT / "docs" / "architecture.md"], ids=named)
def test_functions_named_after_a_file_are_in_it(page):
    named_after_files = [
        (file.relative_to(ROOT), name, name in definitions(file))
        for cell in re.split(r"[|\n]", prose(page))
        for file, name in words(cell)
        if file.suffix == ".py" and re.fullmatch(r"_?[A-Za-z]\w*(\.\w+)*", name)
    ]
    assert [(str(file), name) for file, name, there in named_after_files if not there] == []
    assert len(named_after_files) > 10


@pytest.mark.parametrize("page", LIVING, ids=named)
def test_every_dotted_name_of_ours_exists(page):
    missing = []
    for span in CODE.findall(prose(page)):
        match = re.fullmatch(r"((?:dsar|dsar_exporters|dsar_render)(?:\.\w+)+)(?:\(.*\))?", span)
        if match is None:
            continue
        parts = match[1].split(".")
        for length in range(len(parts), 0, -1):
            base = PACKAGES[parts[0]].joinpath(*parts[:length])
            file = base.with_suffix(".py") if base.with_suffix(".py").is_file() else base / "__init__.py"
            if file.is_file():
                break
        rest = ".".join(parts[length:])
        if rest and rest not in definitions(file) and not re.search(rf"\b{rest}\b", file.read_text()):
            missing.append(span)
    assert missing == []


def settings():
    """Return all settings of a run, as `group.name`."""
    return {
        f"{group.name}.{setting.name}"
        for group in dataclasses.fields(TrainConfig)
        if dataclasses.is_dataclass(group.default_factory)
        for setting in dataclasses.fields(group.default_factory)
    }


@pytest.mark.parametrize("page", LIVING, ids=named)
def test_every_setting_that_is_named_exists(page):
    text = page.read_text()
    spans = re.findall(r"(?<![\w./-])(?:model|loss|schedule|atlas)\.[a-z]\w+", " ".join(CODE.findall(text)))
    flags = re.findall(r"--((?:model|loss|schedule|atlas)\.[a-z0-9-]+)", text)
    plain = {flag.replace(".no-", ".").replace("-", "_") for flag in flags}
    assert {name for name in {*spans, *plain} if not name.endswith(".py")} - settings() == set()


@cache
def flags_of(command):
    """Return the flags in a command's help."""
    text = io.StringIO()
    with contextlib.redirect_stdout(text), pytest.raises(SystemExit):
        main([command, "--help"])
    return set(re.findall(r"--[a-z][\w.-]*", re.sub(r"\x1b\[[\d;]*m", "", text.getvalue())))


@pytest.mark.parametrize("command", COMMANDS)
def test_every_flag_of_a_command_in_the_documents_is_one_that_it_has(command):
    lines = [
        line.partition("#")[0]
        for page in LIVING
        for block in re.findall(r"^```sh\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL)
        for line in block.replace("\\\n", " ").splitlines()
        if line.startswith(f"dsar {command} ")
    ]
    assert lines
    used = {flag for line in lines for flag in re.findall(r"--[a-z][\w.-]*", line)}
    assert used - flags_of(command) == set()


def equations(text):
    """Return the numbers in a cell such as "6, 7 motion magnitude" or "9-11 attention"."""
    numbers = set()
    for first, last in re.findall(r"\b(\d{1,2})(?:-(\d{1,2}))?\b", text):
        numbers.update(range(int(first), int(last or first) + 1))
    return numbers


def equation_rows():
    """Return the numbers and the rest of each row of docs/paper.md's table of equations."""
    table = (ROOT / "docs" / "paper.md").read_text().partition("\n| equation")[2].partition("\n\n")[0]
    rows = [line.strip("|").split("|") for line in table.splitlines()[2:]]
    return [(equations(row[0]), row) for row in rows if equations(row[0])]


def test_every_equation_of_the_paper_is_in_the_table():
    numbers = set().union(*(numbers for numbers, _ in equation_rows()))
    assert numbers == set(range(1, 25))


@pytest.mark.parametrize(("numbers", "row"), equation_rows(), ids=lambda value: str(value)[:20])
def test_every_row_of_equations_names_a_function_in_a_file(numbers, row):
    assert any(name in definitions(file) for file, name in words(row[1])), row


@cache
def cited_equations():
    """Return, by equation, the public functions and classes whose docstrings cite it (see test_equations)."""
    found = {}

    def visit(file, body, prefix):
        for node in body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
                text = " ".join((ast.get_docstring(node) or "").split())
                for numbers in re.findall(r"[Ee]quations? (\d+(?:(?:, | and )\d+)*)", text):
                    for number in equations(numbers):
                        found.setdefault(number, []).append((file, prefix + node.name))
                visit(file, node.body, f"{prefix}{node.name}.")

    for file in sorted((ROOT / "dsar").rglob("*.py")):
        if file != ROOT / "dsar" / "network" / "reference.py":
            visit(file, ast.parse(file.read_text()).body, "")
    return found


@pytest.mark.parametrize("number", range(1, 25))
def test_the_table_names_the_function_that_implements_an_equation(number):
    named = {
        reference for numbers, row in equation_rows() if number in numbers for reference in words(row[1])
    }
    implementing = cited_equations().get(number, [])
    assert implementing, f"no public function or class cites equation {number}"
    assert set(implementing) <= named
