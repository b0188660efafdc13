# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Numbers in sentences, and words of fields."""

import ast
from collections.abc import Iterator

import pytest
from conftest import ROOT
from hypothesis import given
from hypothesis import strategies as st

from fdi_ros.system.text import figures, percent


@given(st.floats(1e-9, 1e12), st.integers(2, 6))
def test_a_number_in_a_sentence_has_no_exponent_and_its_digits(value, digits):
    written = figures(value, digits)
    assert "e" not in written
    assert abs(float(written) / value - 1.0) <= 0.5 * 10.0 ** (1 - digits)
    assert float(figures(-value, digits)) == -float(written)
    assert figures(value, digits, "+") == f"+{written}"


@pytest.mark.parametrize(
    ("share", "words"),
    [
        (0.0, "0 %"),
        (3e-5, "below 0.01 %"),
        (0.0004, "0.04 %"),
        (0.004, "0.4 %"),
        (0.005, "0.5 %"),
        (0.006, "1 %"),
        (0.514, "51 %"),
        (0.992, "99 %"),
        (0.995, "99.5 %"),
        (0.9968, "99.7 %"),
        (0.99999, "above 99.99 %"),
        (1.0, "100 %"),
        (1.04, "104 %"),
        (None, "-"),
        (float("nan"), "-"),
    ],
)
def test_only_none_and_all_are_0_and_100_percent(share, words):
    assert percent(share) == words


PACKAGE = ROOT / "fdi_ros"
#: Their tables state the words of each field in other ways.
STATED_ELSEWHERE = (PACKAGE / "config", PACKAGE / "fleet" / "tables.py")


def public_results(tree: ast.Module) -> Iterator[ast.ClassDef]:
    """Yield the public dataclasses and NamedTuples of a module."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            words = map(ast.unparse, [*node.decorator_list, *node.bases])
            if any("dataclass" in one or one == "NamedTuple" for one in words):
                yield node


def is_text(node: ast.stmt) -> bool:
    """Return whether a statement is a string alone, as the docstring of a field is."""
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )


def undocumented(source: str) -> list[str]:
    """Return the fields without words that help() in editors and Sphinx show.

    These are `#:` in the lines of the field or directly above, or a string below. The
    description of a `setting` is in the tables of the parameters.
    """
    lines = source.splitlines()
    missing = []
    for kind in public_results(ast.parse(source)):
        for field, after in zip(kind.body, [*kind.body[1:], ast.Pass()], strict=True):
            if not isinstance(field, ast.AnnAssign) or is_text(after):
                continue
            name = ast.unparse(field.target)
            own = "\n".join(lines[field.lineno - 1 : field.end_lineno])
            above = lines[field.lineno - 2].strip()
            has_words = "#:" in own or above.startswith("#:") or "setting(" in own
            if not has_words and not name.startswith("_"):
                missing.append(f"{kind.name}.{name}")
    return missing


def test_every_field_of_a_public_result_is_documented():
    missing = [
        f"{path.relative_to(ROOT)}: {name}"
        for path in sorted(PACKAGE.rglob("*.py"))
        if not any(path.is_relative_to(one) for one in STATED_ELSEWHERE)
        for name in undocumented(path.read_text(encoding="utf-8"))
    ]
    assert not missing


def test_a_plain_comment_documents_no_field():
    source = """
class Result(NamedTuple):
    a: int  #: a number
    b: int  # a number
    #: a number
    c: int
    d: int
    '''A number.'''
    # a number
    e: int
"""
    assert undocumented(source) == ["Result.b", "Result.e"]


#: `FAR` is a variance ratio of vibration and standard deviations of a start bias.
SEVERAL_MEANINGS = {"FAR"}


def numbers_of(tree: ast.Module) -> Iterator[tuple[str, str]]:
    """Yield name and value of the numeric constants of a module."""
    for node in tree.body:
        if not isinstance(node, ast.Assign):
            continue
        pairs = [(target, node.value) for target in node.targets]
        for target, value in list(pairs):
            if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
                pairs += zip(target.elts, value.elts, strict=True)
        for target, value in pairs:
            is_constant = isinstance(target, ast.Name) and target.id.isupper()
            if is_constant and is_number(value):
                yield target.id, ast.unparse(value)


def is_number(node: ast.expr) -> bool:
    """Return whether a value is a number, or computed from numbers and names."""
    if isinstance(node, ast.Constant):
        return isinstance(node.value, int | float)
    if isinstance(node, ast.BinOp):
        return all(
            isinstance(one, ast.Name) or is_number(one)
            for one in (node.left, node.right)
        )
    return isinstance(node, ast.UnaryOp) and is_number(node.operand)


def test_a_numeric_constant_has_one_meaning():
    values: dict[str, dict[str, str]] = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        for name, value in numbers_of(ast.parse(path.read_text(encoding="utf-8"))):
            values.setdefault(name, {})[str(path.relative_to(ROOT))] = value
    several = {
        name: found for name, found in values.items() if len(set(found.values())) > 1
    }
    assert set(several) <= SEVERAL_MEANINGS, several
