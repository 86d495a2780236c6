"""Rigs of people who do not know this project, by their own equations.

    from strangers.draw import draw_rig
    from strangers.generate import record, settings_of, truth_of

    rig = draw_rig(seed=1, i=0)  # .settings: 4 to 8 of them, with their own load, oil and motion
    recording, settings = record(rig, rig.settings[0], seed=1)  # Recording, Settings
    truth_of(rig, rig.settings[0])  # B (mean, span), beta_e, load, effects with their classes

``settings`` is the same for all recordings of a rig: the config that ``init`` drafts from data
sheet values with errors within the config's own tolerances.  ``rigs`` are ten of them, written
down, with what their loggers write (``record``).
"""
