"""One machine, one or many recordings: its balances by linear least squares (docs/one_machine.md).

A room of its own: it uses no filter and no search of the diagnosis, so that what it says can be
held beside their answers.
"""
