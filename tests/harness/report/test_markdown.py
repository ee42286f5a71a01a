"""Markdown, letter by letter."""

from __future__ import annotations

from harness.report.markdown import to_markdown_table


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
