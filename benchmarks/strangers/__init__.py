"""Rigs of people who have never seen this project; nothing here imports eha_monitor."""
