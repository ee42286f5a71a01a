"""The penalty in training loops of other libraries: one module for each, imported by name.

Each holds what `condwrap.attach` cannot know: which modules are the policy, which tensor of the
output counts, and how to log. docs/frameworks.md says what works in which version.
"""
