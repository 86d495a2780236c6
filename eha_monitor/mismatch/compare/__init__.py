"""What has changed: a recording against healthy ones of the same machine, or of one like it."""
