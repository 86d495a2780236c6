"""Grounds of the proof beside the draws: a published plant, another simulator, the triangle."""
