"""Every constant that decides what is named, with its reason."""

EFFECT = -5.0  # log prior odds of an effect, and of a number of the rig beyond its tolerance
RARE = -0.5  # for each degree of an effect's rarity
FORM_OF_LAW = 0.05  # of what named laws explain: their form error, and nothing that is missing
UNNAMED = -7.0  # of an unknown function: each of its columns pays for itself besides
FORM = 100.0  # log units: what is left above the noise counts in full up to here
TEMPER = 0.3  # power of the evidence between sets: makes the probabilities honest
RIVAL = 0.05  # probability in an effect's place from which another cannot be told from it
FORM_LEAST = 5.0  # times the smallest unknowns: what every right model may need
FORM_SHARE = 0.2  # of the unknowns that names have taken the place of: their form error
BEYOND_FORM = 3.0  # times that: as likely something without a name as form error
EXPLAINED = 0.75  # share of what speaks against the nominal model that pieces must take away
LACKING = 100.0  # times the smallest unknowns, 1 % of what a balance does: it matters
LIKELY = 0.5  # probability from which something is the answer
UNTOLD = 0.3  # of its prior deviation: a number of the rig of which a recording tells little
RIDGE = 3.0  # log units that such numbers may gain together and still stay where the config is
