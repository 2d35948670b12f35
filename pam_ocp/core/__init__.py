"""What stands below all physics: errors, variables, units, files, signals, trajectories."""
