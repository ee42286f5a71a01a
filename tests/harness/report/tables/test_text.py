"""Text of tables, letter by letter."""

from __future__ import annotations

import numpy as np
import pytest

from harness.report.tables.text import interval, number, supported_by, to_markdown_table


def test_a_table_has_its_numbers_to_the_right():
    text = to_markdown_table(["task", "PPO", "n"], [["Hopper", "1.5", "10"], ["Ant", "–", ""]])
    assert text.splitlines() == [
        "| task | PPO | n |",
        "| --- | --: | --: |",
        "| Hopper | 1.5 | 10 |",
        "| Ant | – |  |",
    ]


def test_one_column_is_a_table_too():
    assert to_markdown_table(["task"], []) == "| task |\n| --- |"


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.84, "0.840"), (0.00056, "0.000560"), (0.00005, "5.00e-05"), (123.4, "123"),
        (-12.345, "-12.3"), (0.0, "0"), (2e7, "2.00e+07"), (np.nan, "–"),
    ],
)  # fmt: skip
def test_numbers_have_three_digits(value, text):
    assert number(value) == text


def test_large_numbers_have_no_exponent():
    assert number(4534.9) == "4530"
    assert number(4534.9, 4) == "4535"


def test_an_interval_stands_in_brackets_if_there_is_one():
    assert interval(1.5, 1.0, 2.0) == "1.50 [1.00, 2.00]"
    assert interval(1.5, np.nan, np.nan) == "1.50"


def test_what_a_cell_rests_on():
    assert supported_by(10, 1, 2.345) == "(n 10, 1 failed, finds 2.3)"
    assert supported_by(1, 0, np.nan) == "(n 1, 0 failed, finds –)"
