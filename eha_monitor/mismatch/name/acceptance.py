"""Every constant that decides what is named, with its reason."""

EFFECT = -4.0  # log prior odds of an effect
UNNAMED = -6.0  # of an unknown function: each of its columns pays for itself besides
WRONG_RIG = -4.5  # of a number of the rig beyond its tolerance
LARGEST_SET = 4  # suspects in a set
BEAM = 30  # sets that are carried on
