"""What the trial of the command's hold needs: a rig of its own, and recordings drawn from it."""
