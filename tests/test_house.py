"""What keeps the house readable, counted: types instead of dicts of strings, annotations, keywords,
lines and functions of a size that can be read.
"""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "plenocli"
MOST_SUBSCRIPTS = 5
"""String subscripts in 1000 lines outside files/, where texts are keys of a format."""
MOST_FIELDS = 4
"""Of a dataclass that may be built by position."""
MOST_LINES = 60
"""Of a function, without signature and docstring."""
LEAST_ANNOTATED = 0.7
"""Share of all functions, the private ones too, whose arguments and result say their types."""


@pytest.fixture(scope="module")
def trees():
    """Path -> syntax tree of every module: parsed where the tests run, not wherever they are
    collected, and gone with them.
    """
    return {path: ast.parse(path.read_text()) for path in sorted(PACKAGE.rglob("*.py"))}


def functions(tree):
    return [n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef)]


def public(tree):
    """Functions that others may call: of the module, and methods of its public classes."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
            yield node
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            methods = (n for n in node.body if isinstance(n, ast.FunctionDef))
            yield from (m for m in methods if m.name == "__init__" or not m.name.startswith("_"))


def annotated(function):
    """Whether all arguments but self and cls, and the result, have types."""
    given = function.args
    named = [*given.posonlyargs, *given.args, *given.kwonlyargs]
    named = named[1:] if named and named[0].arg in ("self", "cls") else named
    named += [extra for extra in (given.vararg, given.kwarg) if extra is not None]
    result = function.returns is not None or function.name == "__init__"
    return result and all(argument.annotation is not None for argument in named)


def dataclasses(tree):
    """(class, number of fields, whether it is built by keyword) of the dataclasses of a module."""
    for node in (n for n in ast.walk(tree) if isinstance(n, ast.ClassDef)):
        how = [ast.unparse(d) for d in node.decorator_list if "dataclass" in ast.unparse(d)]
        if how:
            fields = sum(isinstance(n, ast.AnnAssign) for n in node.body)
            yield node.name, fields, "kw_only=True" in how[0]


def test_texts_are_no_field_names(trees):
    lines = subscripts = 0
    for path, tree in trees.items():
        if path.relative_to(PACKAGE).parts[0] != "files":
            lines += len(path.read_text().splitlines())
            subscripts += sum(
                isinstance(node, ast.Subscript)
                and isinstance(node.slice, ast.Constant)
                and isinstance(node.slice.value, str)
                for node in ast.walk(tree)
            )
    assert subscripts <= MOST_SUBSCRIPTS * lines / 1000, (subscripts, lines)


def test_public_functions_say_their_types(trees):
    without = [
        f"{path.relative_to(ROOT)}: {function.name}"
        for path, tree in trees.items()
        for function in public(tree)
        if not annotated(function)
    ]
    assert not without


def test_most_functions_say_their_types(trees):
    found = [annotated(function) for tree in trees.values() for function in functions(tree)]
    assert sum(found) >= LEAST_ANNOTATED * len(found), (sum(found), len(found))


def test_many_fields_are_given_by_keyword(trees):
    positional = [
        f"{path.relative_to(ROOT)}: {name} has {fields} fields"
        for path, tree in trees.items()
        for name, fields, by_keyword in dataclasses(tree)
        if fields > MOST_FIELDS and not by_keyword
    ]
    assert not positional


def body(function):
    """Lines of a function below its docstring."""
    first = function.body[1 if ast.get_docstring(function) and len(function.body) > 1 else 0]
    return function.end_lineno - first.lineno + 1


def test_functions_and_lines_can_be_read(trees):
    long = [
        f"{path.relative_to(ROOT)}: {node.name} has {body(node)} lines"
        for path, tree in trees.items()
        for node in functions(tree)
        if body(node) > MOST_LINES
    ]
    assert not long
    wide = [path for path in trees if any(len(s) > 100 for s in path.read_text().splitlines())]
    assert not wide


def test_the_counts_see_what_they_must_refuse():
    fields = "".join(f"    {name}: int\n" for name in "abcde")
    tree = ast.parse(
        f"@dataclass(frozen=True)\nclass A:\n{fields}    def f(self, x): pass\n"
        "def g(x: int) -> int: return x\ndef _h(y): pass\n"
    )
    assert [annotated(function) for function in public(tree)] == [False, True]
    assert list(dataclasses(tree)) == [("A", 5, False)]
