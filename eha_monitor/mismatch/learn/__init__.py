"""A model for what has no name: an unknown function of the signals, and a formula for it."""
