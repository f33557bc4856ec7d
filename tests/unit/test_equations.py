"""Each equation of the paper is found by its number, in one docstring: of the code that implements it."""

import ast
import re
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).parents[2]
NUMBERS = range(1, 25)
REFERENCE = ROOT / "dsar" / "network" / "reference.py"
"""The paper as text, to which the implementing code is held."""
CITATION = re.compile(r"[Ee]quations?\s+(\d+(?:\s*(?:,|and|-|\u2013|to)\s*\d+)*)")


def public_docstrings(path: Path) -> dict[str, str]:
    """Return the docstrings of a module and of what it holds that no underscore hides, by qualified name."""
    found = {}

    def visit(node: ast.AST, name: str) -> None:
        found[name] = ast.get_docstring(node) or ""
        previous: ast.AST | None = None
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.ClassDef | ast.FunctionDef) and not child.name.startswith("_"):
                visit(child, f"{name}.{child.name}")
            # A string beneath an attribute is its docstring.
            if isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant) and previous is not None:
                target = getattr(previous, "target", None) or getattr(previous, "targets", [None])[0]
                attribute = getattr(target, "id", "_")
                if isinstance(child.value.value, str) and not attribute.startswith("_"):
                    found[f"{name}.{attribute}"] = child.value.value
            previous = child if isinstance(child, ast.AnnAssign | ast.Assign) else None

    visit(ast.parse(path.read_text()), str(path.relative_to(ROOT).with_suffix("")).replace("/", "."))
    return found


def citations(path: Path) -> dict[int, list[str]]:
    """Return who cites each equation in a module's public docstrings; each number is to be written out."""
    cited = defaultdict(list)
    for name, text in public_docstrings(path).items():
        for numbers in CITATION.findall(text):
            assert not re.search(r"-|\u2013|to", numbers), (
                f"{name}: write out the numbers of equations {numbers}"
            )
            for number in re.findall(r"\d+", numbers):
                cited[int(number)].append(name)
    return cited


def test_every_equation_is_in_one_public_docstring_of_the_code_that_implements_it():
    cited = defaultdict(list)
    for package in ("dsar", "exporters", "render"):
        for path in sorted((ROOT / package).rglob("*.py")):
            if path != REFERENCE:
                for number, names in citations(path).items():
                    cited[number] += names
    assert {number: cited[number] for number in NUMBERS if len(cited[number]) != 1} == {}
    assert set(cited) == set(NUMBERS)


def test_the_reference_holds_the_equations_of_the_network():
    assert set(range(4, 17)) <= set(citations(REFERENCE))
