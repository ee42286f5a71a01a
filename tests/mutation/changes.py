"""The small changes: mutmut's operators, which keep comments and layout, and others of our own."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterator

import libcst as cst
from libcst.metadata import MetadataWrapper
from mutmut.mutation import mutators

# what a call becomes: mistakes that type checkers and shapes don't reveal
CALLS = {
    "mean": "sum",
    "sum": "mean",
    "median": "mean",
    "min": "max",
    "max": "min",
    "any": "all",
    "all": "any",
    "ceil": "floor",
    "sqrt": "square",
    "square": "sqrt",
}


def is_strict(node: cst.CSTNode) -> bool:
    keyword = node.keyword if isinstance(node, cst.Arg) else None
    return keyword is not None and keyword.value == "strict"


def other_call(node: cst.Call) -> Iterator[cst.CSTNode]:
    name = node.func.attr if isinstance(node.func, cst.Attribute) else node.func
    if isinstance(name, cst.Name) and name.value in CALLS:
        yield node.with_deep_changes(name, value=CALLS[name.value])


def drop_argument(node: cst.Call) -> Iterator[cst.CSTNode]:
    """Without a keyword's argument, or the last one: others leave a call that raises."""
    for i, arg in enumerate(node.args):
        can_go = arg.keyword or (i > 0 and i == len(node.args) - 1)
        if can_go and not is_strict(arg):
            yield node.with_changes(args=[*node.args[:i], *node.args[i + 1 :]])


def negate_test(node: cst.If | cst.While) -> Iterator[cst.CSTNode]:
    test = node.test.with_changes(lpar=[cst.LeftParen()], rpar=[cst.RightParen()])
    yield node.with_changes(test=cst.UnaryOperation(cst.Not(), test))


def drop_statement(node: cst.SimpleStatementLine) -> Iterator[cst.CSTNode]:
    body = node.body[0]
    is_call = isinstance(body, cst.Expr) and isinstance(body.value, cst.Call)
    if is_call or isinstance(body, cst.AugAssign):
        yield node.with_changes(body=[cst.Pass()])


def other_string(node: cst.SimpleString) -> list[cst.CSTNode]:
    return list(mutators.operator_string(node))[:1]  # the others change its case


def drop_context(node: cst.With) -> Iterator[cst.CSTNode]:
    if not any(item.asname for item in node.items):
        yield cst.If(test=cst.Name("True"), body=node.body)


Change = tuple[cst.CSTNode, cst.CSTNode]
Operator = Callable[..., Iterator[cst.CSTNode] | list[cst.CSTNode]]
OPERATORS: list[tuple[object, Operator]] = [
    (cst.BaseNumber, mutators.operator_number),
    (cst.SimpleString, other_string),
    (cst.Name, mutators.operator_name),
    (cst.AugAssign, mutators.operator_augmented_assignment),
    (cst.UnaryOperation, mutators.operator_remove_unary_ops),
    (cst.CSTNode, mutators.operator_keywords),
    (cst.CSTNode, mutators.operator_swap_op),
    (cst.IfExp, mutators.operator_if_exp),
    (cst.Call, other_call),
    (cst.Call, drop_argument),
    (cst.If | cst.While, negate_test),
    (cst.SimpleStatementLine, drop_statement),
    (cst.With, drop_context),
]


def find_changes(node: cst.CSTNode, told: bool = False) -> Iterator[Change]:
    """Each node that can change and what takes its place.

    Annotations, the `strict` of zip, which acts on a bug alone, and the wording of errors are left
    out; `told` says that an error is being raised.
    """
    if isinstance(node, cst.Annotation | cst.Import | cst.ImportFrom) or is_strict(node):
        return

    told = told or isinstance(node, cst.Raise)
    for kind, operator in OPERATORS:
        if isinstance(node, kind) and not (told and isinstance(node, cst.SimpleString)):
            for changed in operator(node):
                yield node, changed
    for child in node.children:
        yield from find_changes(child, told)


def make_mutants(source: str) -> dict[str, str]:
    """All mutants of a module: a line that says what changes, and the module's text.

    A change to a line that occurs several times is numbered from the second on.
    """
    module = MetadataWrapper(cst.parse_module(source)).module
    mutants: dict[str, str] = {}
    for node, changed in find_changes(module):
        text = module.deep_replace(node, changed).code
        lines = difflib.ndiff(source.splitlines(), text.splitlines())
        name = " ".join(f"{line[0]} {line[2:].strip()}" for line in lines if line[0] in "+-")
        alike = sum(other.startswith(name) for other in mutants)
        mutants[f"{name} ({alike + 1})" if alike else name] = text
    return mutants
