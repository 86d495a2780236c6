"""Whether a recording and its config can be of one rig: signs, units, channels.

A swapped pair of pressures or millimetres for metres does not make a filter fail: it makes it
answer something else.  So the relations that hold on every rig (a force accelerates a mass, a
pump moves a piston, a piston follows its command) are checked before any filter, with ordinary
least squares on smoothed signals; where they fail, every usual mistake is tried on them.
"""
