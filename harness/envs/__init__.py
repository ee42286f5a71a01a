"""Environments that the harness brings along."""
