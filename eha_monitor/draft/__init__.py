"""A first config for a recording that nobody has described: columns, units, geometry.

What is in the draft says where it comes from: the header, the values, an answer, or the paper.
What nobody has told is marked with ``ASK``; no geometry is made up.
"""
