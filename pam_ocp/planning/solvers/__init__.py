"""IPOPT, fatrop, compiled functions; diagnosis and multipliers."""
