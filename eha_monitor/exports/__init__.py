"""The identified model in the formats of other programs."""
