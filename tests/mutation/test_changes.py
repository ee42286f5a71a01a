"""The changes that `make mutate` makes."""

import pytest

pytest.importorskip("libcst", reason="`make mutate` installs it")
pytest.importorskip("mutmut", reason="`make mutate` installs it")

from tests.mutation.changes import make_mutants


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("x = a + 1", {"x = a - 1", "x = a + 2"}),
        ("x = y if z else w", {"x = y if (z) and False else w", "x = y if (z) or True else w"}),
        ("x = f(1 < a)", {"x = f(1 <= a)", "x = f(2 < a)"}),
        ("x = y.mean()", {"x = y.sum()"}),
        ("x = f(a, b=c)", {"x = f(a, )"}),
        ("x = not y", {"x = y"}),
        ("x = 'a'", {"x = 'XXaXX'"}),
        ("f()", {"pass"}),
        ("x += y", {"x = y", "x -= y", "pass"}),
        ("if x: y", {"if not (x): y"}),
        ("x = zip(a, strict=True)", set()),
        ("with a(): y", {"if True: y"}),
        ("with a() as b: y", set()),
        ("x: int | None = y", set()),
        ("import a.b", set()),
        ("raise E(f'{x}', 'because')", {"raise E(f'{x}', )"}),
        ('"""A docstring."""', set()),
    ],
)
def test_the_changes_to_a_line(before, after):
    assert {text.strip() for text in make_mutants(before + "\n").values()} == after


def test_a_change_is_named_by_its_line_and_keeps_the_comments():
    mutants = make_mutants("# why\nx = 1  # condwrap\n")
    assert mutants == {"- x = 1  # condwrap + x = 2  # condwrap": "# why\nx = 2  # condwrap\n"}


def test_the_same_change_in_two_places_counts_twice():
    mutants = make_mutants("if a:\n    f()\nif b:\n    f()\n")
    assert list(mutants)[1:] == ["- f() + pass", "- if b: + if not (b):", "- f() + pass (2)"]
