"""An experiment that decides: motions within limits, each planned by what the last one left."""
