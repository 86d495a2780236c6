"""Recordings with concealed effects, from a plant that shares no equation with the diagnosis."""
