"""The config: declared once, with unit, range and description of every key."""

from eha_monitor.settings.load import load_settings, settings_from_tree
from eha_monitor.settings.monitor import Settings

__all__ = ["Settings", "load_settings", "settings_from_tree"]
