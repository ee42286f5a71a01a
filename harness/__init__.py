"""Runs the paper's experiments and reports them beside its tables: `python -m harness --help`."""
