"""The commands: each parses its options, calls one function and prints its answer.

Nothing heavy is imported before a command runs, so that ``--help`` is quick.
"""
