"""Digest of the code that computes a model's matrices: what was measured of it holds until the
digest changes.

The code of a model is everything that the module of its fields and the builder of matrices import
within the package, at any depth. The table of the models is left out, or each would depend on all.
"""

from __future__ import annotations

import ast
import hashlib
from functools import cache
from pathlib import Path

from plenocli.forward.propagation.models import model_named

BUILDER = "plenocli.forward.propagation.system_matrix"
TABLE = "plenocli.forward.propagation.models"
PLANNING = {
    "cost",
    "features",
    "field_features",
    "pupil_waves",
    "valid_for",
    "error_bound",
    "paraxial_error",
    "exact_band",
    "size_band",
    "_chord_counts",
    "field_products",
    "field_rank",
    "field_terms",
    "require_sketch",
}
"""Functions that plan and do not compute: what was measured outlives their changes, since a plan
is part of what it is kept by.
"""


def model_code(name: str, root: Path) -> str:
    """Digest of the code that computes the model `name`, of the package in the folder `root`."""
    parts = [
        f"{module} {_parsed(path_of(module, root).read_text(encoding='utf-8'))[0]}"
        for module in modules_of(name, root)
    ]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:12]


def modules_of(name: str, root: Path) -> list[str]:
    """Names of the modules that compute the model `name`, in alphabetical order."""
    found, todo = set(), [model_named(name).lenslets.module, BUILDER]
    while todo:
        module = todo.pop()
        path = None if module in found or module == TABLE else path_of(module, root)
        if path:
            found.add(module)
            todo += _parsed(path.read_text(encoding="utf-8"))[1]
    return sorted(found)


@cache
def _parsed(text: str) -> tuple[str, list[str]]:
    """(what of a module's text computes, names of the modules that it may import)."""
    tree, names = computing(text), []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
    return ast.dump(tree), names


def path_of(module: str, root: Path) -> Path | None:
    """The file of a module of the package, None for anything else."""
    if module.split(".")[0] != "plenocli":
        return None
    stem = root.joinpath(*module.split("."))
    return next((p for p in (stem.with_suffix(".py"), stem / "__init__.py") if p.is_file()), None)


def computing(text: str) -> ast.Module:
    """The syntax tree of a module's text without docstrings, annotations, imports for these alone
    and functions that plan.
    """
    tree = ast.parse(text)
    tree.body = [
        node
        for node in tree.body
        if getattr(node, "name", None) not in PLANNING and not _for_types(node)
    ]
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            # a string in the place of a statement is a docstring
            node.body = [statement for statement in body if not _is_text(statement)]
        if isinstance(node, ast.FunctionDef):
            node.returns = None
        elif isinstance(node, ast.arg):
            node.annotation = None
    return tree


def _for_types(node: ast.stmt) -> bool:
    return (
        isinstance(node, ast.If)
        and isinstance(node.test, ast.Name)
        and node.test.id == "TYPE_CHECKING"
    )


def _is_text(node: ast.stmt) -> bool:
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )
